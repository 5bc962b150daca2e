"""`python -m torchdls`: the same as the command `torchdls`."""

import sys

from torchdls.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
