"""From a message to what is published of it: what the live nodes and the offline commands share."""
