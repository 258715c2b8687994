"""Other nodes of the graph: a player of recordings, listeners."""
