"""Let ``git status`` see past the results in a notebook: called by Jupyter after each save.

Git's filter strips results from what git reads (``make`` sets it up). But ``git status`` does not read a file whose
size has changed: it calls it modified. Entering the same blob into the index again, without size and time, makes git
read the file through the filter the next time. Nothing is staged: what a student has written still shows.
"""

import subprocess
from pathlib import Path
from typing import Any


def after_save(model: dict[str, Any], os_path: str, contents_manager: Any) -> None:
    """Make git compare a saved notebook by its content; the signature is that of Jupyter's ``post_save_hook``.

    Does nothing for other files, outside a repository, and for a file that git does not know.
    """
    if model["type"] == "notebook":
        compare_by_content(Path(os_path))


def compare_by_content(path: Path) -> None:
    """Forget the size and time that git's index holds for a file, so that git reads it again."""
    try:
        known = subprocess.run(
            ["git", "ls-files", "--stage", "--full-name", "--", path.name],
            cwd=path.parent,
            capture_output=True,
            check=True,
        ).stdout
        if known:
            top = subprocess.run(
                ["git", "rev-parse", "--show-toplevel"], cwd=path.parent, capture_output=True, check=True, text=True
            ).stdout.strip()
            subprocess.run(
                ["git", "update-index", "--index-info"], cwd=top, input=known, capture_output=True, check=True
            )
    except (OSError, subprocess.CalledProcessError):
        return  # no git, no repository, or its index is locked: the file shows as modified, and nothing is lost
