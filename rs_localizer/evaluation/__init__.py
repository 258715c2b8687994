"""How far estimates are from the truth, in numbers and pictures."""
