"""The same for the benchmarks that pytest runs."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
