"""From the points of one image to the posterior of its motion."""
