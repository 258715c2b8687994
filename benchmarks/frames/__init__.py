# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames judged and two versions compared: are the regions true, sharp, and what do they cost?

Truth comes from the independent simulator, estimates from the public interfaces of whichever
version of the package Python finds (``PYTHONPATH``). See ``python -m benchmarks.frames --help``.
"""
