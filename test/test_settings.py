# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Settings by dotted name: the shipped params file, ROS 2 params files, assignments."""

from pathlib import Path

import pytest

from rs_localizer import config
from rs_localizer.settings import SettingsError, build, load_params_file, parse_assignment, settings

SHIPPED = Path(__file__).parents[1] / "config"


def params(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("file", "kind"),
    [
        ("rs_localizer.yaml", config.NodeConfig),
        ("marker_detector.yaml", config.DetectorConfig),
        ("feature_detector.yaml", config.FeatureConfig),
    ],
)
def test_the_shipped_files_hold_exactly_the_defaults_and_name_all_choices(file, kind):
    path = SHIPPED / file
    values, known = load_params_file(path, kind), settings(kind)
    assert values == {name: setting.default for name, setting in known.items()}
    assert all(type(value) is type(known[name].default) for name, value in values.items())
    assert build(values, kind) == kind()
    lines = [line.strip() for line in path.read_text().splitlines()]
    for name, setting in known.items():
        assert setting.description, name
        if name == "solver":  # of which there is one list, and one page
            continue
        leaf = name.rsplit(".", 1)[-1]
        line = next((line for line in lines if line.startswith(f"{leaf}:")), "")
        assert all(choice in line for choice in setting.choices), name


OTHERS = "other_node:\n  ros__parameters: {frequency: 3}\n"
MANY = """
robot:
  rs_localizer:
    ros__parameters:
      velocity_prior: {angular: 0.5}
      velocity_prior.linear: 1e-3
/**:
  ros__parameters:
    use_sim_time: true
    qos_overrides: {/camera_info: {subscription: {depth: 3}}}
    seed: 7
"""


@pytest.mark.parametrize(
    ("text", "values"),
    [
        *((f"{heading}:\n  ros__parameters:\n    seed: 5\n", {"seed": 5})
          for heading in ("rs_localizer", "/robot/rs_localizer", "/**/rs_localizer", "/*")),
        (MANY, {"velocity_prior.angular": 0.5, "velocity_prior.linear": 1e-3, "seed": 7}),
    ],
)  # fmt: skip
def test_what_is_meant_for_the_node(tmp_path, text, values):
    assert load_params_file(params(tmp_path, text + OTHERS)) == values
    built = build(values)
    assert built.seed == values["seed"]
    moves = config.VelocityPrior(0.5, 1e-3)
    assert built.velocity_prior == moves or "velocity_prior.angular" not in values


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("/**:\n  ros__parameters:\n    sead: 5\n", "'sead' is not a setting; did you mean seed"),
        ("/**:\n  ros__parameters:\n    velocity_prior: 5\n", "'velocity_prior' is not a setting"),
        ("/**:\n  ros__parameters: 5\n", "ros__parameters of /.* must be a mapping"),
        ("other:\n  ros__parameters:\n    seed: 5\n", "has no ros__parameters for /rs_localizer"),
        ("a: [", "is not a YAML file"),
    ],
)
def test_files_that_cannot_be_used(tmp_path, text, fault):
    with pytest.raises(SettingsError, match=fault):
        load_params_file(params(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("solver:=p3p", "solver", "p3p"),
        ("readout_time:=0.03", "readout_time", 0.03),
        ("velocity_prior.linear:=1e-2", "velocity_prior.linear", 0.01),
        ("gravity_in_map:=[0, 1.5, 0]", "gravity_in_map", (0, 1.5, 0)),
        ("seed:=3", "seed", 3),
        ("autostart:=false", "autostart", False),
    ],
)
def test_assignments(text, name, value):
    assert parse_assignment(text) == (name, value)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"solver": "epnp"}, "solver must be one of .*; got 'epnp'"),
        ({"seed": 1.5}, "seed must be of type int, got 1.5"),
        ({"velocity_prior.linear": -1.0}, "linear must lie between 0.0 and 10000.0 m/s, got -1"),
        ({"readout_time": 30.0}, "readout_time must lie between 0.0 and 0.2 s, got 30.0"),
        ({"imu.use": "yes"}, "imu.use must be one of auto, none; got 'yes'"),
        ({"gravity_in_map": [0.0, 1.0]}, r"must be 3 numbers, as \[0.0, 0.0, -1.0\]"),
    ],
)
def test_wrong_values(values, fault):
    with pytest.raises(ValueError, match=fault):
        build(values)


@pytest.mark.parametrize("value", [None, {"focal_length": 0.01}])
@pytest.mark.parametrize("name", ["velocity_prior", "acceleration", "calibration"])
def test_a_group_of_settings_is_of_its_own_class(name, value):
    with pytest.raises(ValueError, match=rf"{name} must be of type \w+, got {value}"):
        config.LocalizerConfig(**{name: value})
