"""Make a copy of the repository for students, without the worked answers: ``make student``.

The copy has notebooks, library, recorded flights and pages, and sets itself up with ``make lab``. Left out are the
solutions, every sentence that leads to them, and the tests, which hold right answers, too. The graders come along: who
reads ``fiplib/teaching/exercises/`` finds the right results in them, as a grader must know them.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

from fiplib.params import FipError
from fiplib.teaching.notebook import ROOT

PARTS = (
    "fiplib", "notebooks", "data", "docs", "figures", "scripts", "Makefile", "README.md", "CONTRIBUTING.md",
    "CODE_OF_CONDUCT.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "LICENSE-TEXT", "pyproject.toml",
    "requirements.lock", "environment.yml", "postBuild", ".gitattributes", ".gitignore",
)  # fmt: skip
"""Files and folders of the repository that students get."""

SOLUTIONS = "notebooks/solutions"


def handout(target: Path, root: Path = ROOT) -> list[Path]:
    """Write the copy for students into a folder, and beside it as ``<folder>.zip``; return the files of the copy.

    An earlier copy there is replaced. Raises FipError: ``root`` is no clone of the repository, so that nobody knows
    which of its files belong to it, or ``target`` holds something else than such a copy.
    """
    tracked = subprocess.run(["git", "ls-files", "-z", "--", *PARTS], cwd=root, capture_output=True, text=True)
    if tracked.returncode or not tracked.stdout:
        raise FipError(
            f"{root} is no clone of the repository: clone it with git, then make the copy for students there."
        )
    if target.exists():
        if not (target / "notebooks").is_dir():
            raise FipError(f"{target} is not a copy for students: remove it, or name another folder.")
        shutil.rmtree(target)
    written = []
    for name in tracked.stdout.rstrip("\0").split("\0"):
        if name.startswith(f"{SOLUTIONS}/") or not (root / name).is_file():
            continue
        place = target / name
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.match("notebooks/*.ipynb"):
            place.write_text(without_solutions((root / name).read_text(encoding="utf-8")), encoding="utf-8")
        else:
            shutil.copyfile(root / name, place)
        written.append(place)
    shutil.make_archive(str(target), "zip", target.parent, target.name)
    return written


def without_solutions(text: str) -> str:
    """Return a notebook's text without outputs and without the paragraphs that link to solutions."""
    notebook = json.loads(text)
    for cell in notebook["cells"]:
        if cell["cell_type"] == "markdown":
            paragraphs = "".join(cell["source"]).split("\n\n")
            kept = "\n\n".join(words for words in paragraphs if "](solutions/" not in words)
            cell["source"] = kept.splitlines(keepends=True)
        else:
            cell |= {"outputs": [], "execution_count": None}
    notebook["cells"] = [cell for cell in notebook["cells"] if cell["source"] or cell["cell_type"] == "code"]
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/student")
    try:
        print(f"{folder}: {len(handout(folder))} files without solutions, and {folder}.zip")
    except FipError as error:
        sys.exit(str(error))
