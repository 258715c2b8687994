"""What replay found, for the Rerun viewer: nothing here changes a pose."""
