"""Benchmarks measure what the command line does: threads that wait sleep. Read once, when PyTorch is loaded."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
