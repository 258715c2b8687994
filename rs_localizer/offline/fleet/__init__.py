"""Many recordings by Dask: each a task of its own, whichever process or machine does it."""
