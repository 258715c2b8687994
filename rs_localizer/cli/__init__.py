"""The commands: each one small file that parses, calls and prints."""


class UsageError(ValueError):
    """Wrong arguments that argparse cannot see by itself."""
