"""Recordings and files through the pipeline."""
