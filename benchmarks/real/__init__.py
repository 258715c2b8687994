"""Real videos of boards, judged without a truth: repeatability, held-out corners, neighbours."""
