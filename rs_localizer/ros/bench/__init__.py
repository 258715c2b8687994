"""Programs that measure live nodes."""
