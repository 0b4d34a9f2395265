"""The film is small, loops, runs at twenty pictures a second and shows the flight that it names."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from fiplib import bags
from fiplib.teaching import film

ROOT = Path(__file__).parents[2]
FILM = ROOT / "docs/static/film.webp"


@pytest.fixture(scope="module")
def flight():
    return bags.read(ROOT / "data/estimate-1.4")


def test_the_film_is_under_two_megabytes_loops_for_ever_and_has_twenty_pictures_a_second(flight):
    assert FILM.stat().st_size < 2e6
    with Image.open(FILM) as made:
        durations = []
        for picture in ImageSequence.Iterator(made):
            picture.load()  # only then is its duration known
            durations.append(picture.info["duration"])
        assert made.info["loop"] == 0
        assert made.n_frames == film.count(flight) == len(durations)
        # a picture that equals the one before is that one shown for longer
        assert np.mean(durations) <= 50 and min(durations) >= 20
        assert sum(durations) == pytest.approx(1000 * flight.duration / film.SPEED, abs=60)


def test_pictures_drawn_from_the_recorded_flight_now_are_those_of_the_film(flight):
    numbers = [0, 56, 170]  # the start, just after the first estimate, late
    with Image.open(FILM) as made:
        for number, drawn in zip(numbers, film.pictures(flight, numbers), strict=True):
            made.seek(number)
            assert drawn.size == made.size
            here, there = np.asarray(drawn).astype(int), np.asarray(made.convert("RGB")).astype(int)
            # exact with the pinned packages; another build of FreeType may round the edge of a letter otherwise
            assert (np.abs(here - there).max(axis=2) > 8).mean() < 1e-3, number


def test_pictures_of_other_times_are_others(flight):
    first, second = film.pictures(flight, [20, 60])
    changed = np.abs(np.asarray(first).astype(int) - np.asarray(second)).max(axis=2) > 30
    assert 1e-3 < changed.mean() < 0.2  # lines move, the axes stay


def test_a_film_of_another_flight_is_written_in_the_same_way(flight, tmp_path, monkeypatch):
    monkeypatch.setattr(film, "PICTURES", 2.0)
    path = tmp_path / "folder" / "film.webp"
    film.write(flight, path)
    with Image.open(path) as made:
        assert made.n_frames == film.count(flight) == 25 and made.info["loop"] == 0
