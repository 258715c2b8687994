# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Many recordings by Dask: each a task of its own, whichever process or machine does it."""
