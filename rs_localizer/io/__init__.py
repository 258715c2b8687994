"""What goes in and out: messages, recordings, trajectories; no ROS needed."""
