"""How good refined maps and surveyed markers are, on rooms whose truth is known."""
