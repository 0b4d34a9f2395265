"""The page figures/README.md and its images are what ``make figures`` makes, and they are small."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fiplib import products
from fiplib.reproduction import gallery

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("figures")
    products.write_gallery(ROOT / "data", folder)
    return folder


def test_the_page_is_the_one_that_is_made_and_leads_to_what_exists(made):
    text = (ROOT / "figures/README.md").read_text()
    assert text == (made / "README.md").read_text()
    for name in gallery.NAMES:
        assert f"(small/{name}.png)" in text and f"`fip figures {name}`" in text


@pytest.mark.parametrize("name", gallery.NAMES)
def test_an_image_is_the_one_that_is_made_and_small(name, made):
    committed = (ROOT / f"figures/small/{name}.png").read_bytes()
    assert len(committed) < 60_000
    ours, theirs = (
        np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), dtype=float)
        for content in (committed, (made / f"small/{name}.png").read_bytes())
    )
    assert ours.shape == theirs.shape
    # the same bytes on the locked packages; on another CPU the last bit of a number may move the edge of a line, and
    # with it a colour of the palette: a drawing that differs in a line or a word differs in more than these pixels
    differing = np.abs(ours - theirs).max(axis=2) > 32.0
    assert np.count_nonzero(differing) <= 1e-3 * differing.size
