"""What every node of this package needs."""
