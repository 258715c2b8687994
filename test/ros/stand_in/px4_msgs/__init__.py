"""What the tests need of px4_msgs, which is not on PyPI: no support for its type in DDS."""
