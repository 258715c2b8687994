# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The experiments of the literature and our own, each one function; see ``benchmarks.__main__``.

They reproduce Kukelova, Albl, Sugimoto, Pajdla, "Linear solution to the minimal absolute pose
rolling shutter problem", ACCV 2018 ("the paper" throughout), and hold each of its claims, and
those that this project makes, against the figures that come out.
"""
