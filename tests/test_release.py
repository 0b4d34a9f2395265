"""What a release states of itself agrees."""

import json
from pathlib import Path

import fiplib

ROOT = Path(__file__).parents[1]


def test_the_version_is_the_same_everywhere():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    archive = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    assert f"\nversion: {fiplib.__version__}\n" in citation
    assert archive["version"] == fiplib.__version__


def test_archive_and_citation_name_the_same_work():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    archive = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    assert f'title: "{archive["title"]}"' in citation
    assert f"license: {archive['license']}\n" in citation
    assert [f"  - {word}" in citation for word in archive["keywords"]] == [True] * len(archive["keywords"])


def test_the_changes_have_a_section_for_what_comes_next_or_for_this_version():
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert "\n## Unreleased\n" in changes or f"\n## {fiplib.__version__} " in changes
