# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled arithmetic: how kernels are compiled, and what they are made of."""
