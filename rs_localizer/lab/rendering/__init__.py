"""Images of a simulated scene."""
