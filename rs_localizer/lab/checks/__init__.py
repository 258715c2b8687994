"""Programs that look for faults and for lost time."""
