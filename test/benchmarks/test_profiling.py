from benchmarks.profiling import main


def test_the_profile_names_the_kernels(capsys):
    main(["--frames", "2", "--points", "30", "--lines", "40"])
    printed = capsys.readouterr().out
    for name in ("optimize", "best_models", "localize"):
        assert name in printed
