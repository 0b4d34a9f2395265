"""``fip figures``: make figures, tables and the ledger from recorded flights and finished tables."""

import argparse
import sys
from pathlib import Path

from fiplib.params import FipError
from fiplib.products import GALLERY, LEDGER, PRODUCTS, ledger, make, page, write, write_gallery, write_ledger
from fiplib.reproduction import making


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``fip figures``."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="which to make (default: all)")
    parser.add_argument("--list", action="store_true", help="list them with what they are made from")
    parser.add_argument("--make", action="store_true", help="print the same for the Makefile")
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the bags (default: data)")
    parser.add_argument("--output", type=Path, default=Path("figures"), help="folder to write to (default: figures)")
    parser.add_argument(
        "--generated", type=Path, default=Path("paper/generated"), help=f"folder for the LaTeX files of {LEDGER}"
    )


def run(options: argparse.Namespace) -> int:
    """Make figures, tables and the ledger; return the exit status: 1 if some of several could not be made.

    Raises FipError: no such product, or the only one cannot be made.
    """
    if options.make:
        print(making.makefile(PRODUCTS, {GALLERY: page(), LEDGER: ledger()}), end="")
        return 0
    everything = PRODUCTS | {GALLERY: page(), LEDGER: ledger()}
    if options.list:
        for name, product in everything.items():
            print(f"{name:22} {' '.join(product.names) or '(parameters only)'}")
        return 0
    if unknown := [name for name in options.names if name not in everything]:
        raise FipError(f"no figure {unknown[0]!r}; there are {', '.join(everything)}")
    failed = 0
    for name in (names := options.names or list(everything)):
        try:
            if name == LEDGER:
                paths = write_ledger(options.data, options.output, options.generated)
            elif name == GALLERY:
                paths = write_gallery(options.data, options.output)
            else:
                paths = write(name, make(name, options.data), options.output)
            print("wrote", *paths, flush=True)
        except FipError as error:  # the others are made all the same
            if len(names) == 1:
                raise
            failed += 1
            print(f"fip: {name}: {error}", file=sys.stderr)
    return int(failed > 0)
