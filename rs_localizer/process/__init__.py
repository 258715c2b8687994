"""What every program begins with: signals, threads, arguments, and what is not installed."""
