"""The one command of the package: ``fip``, or ``python -m fiplib``."""

import argparse
import sys

from fiplib import products
from fiplib.params import FipError


def main() -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="fip")
    commands = parser.add_subparsers(dest="command", required=True)
    products.add_arguments_figures(commands.add_parser("figures"))
    products.add_arguments_claims(commands.add_parser("claims"))
    products.add_arguments_sweep(commands.add_parser("sweep"))
    options = parser.parse_args()
    runs = {"figures": products.run_figures, "claims": products.run_claims, "sweep": products.run_sweep}
    try:
        return runs[options.command](options)
    except (FipError, OSError) as error:
        print(f"fip: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
