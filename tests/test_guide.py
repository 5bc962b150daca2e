"""The pictures of the guide: each is drawn by `make pictures`, shown in a page, and small."""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

pictures: Any = import_module("docs.pictures")
DOCS = Path(__file__).resolve().parents[1] / "docs"


def test_every_picture_is_drawn_shown_and_small() -> None:
    kept = {path.stem: path.stat().st_size for path in (DOCS / "pictures").iterdir()}
    shown = set(re.findall(r"\]\(pictures/(\w+)\.webp\)", " ".join(p.read_text("utf-8") for p in DOCS.glob("*.md"))))
    assert set(kept) == set(pictures.PICTURES) == shown
    assert max(kept.values()) < 100_000


@pytest.mark.slow
def test_pictures_are_drawn_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "told", lambda name: pytest.fail("a trial writes nothing into the pages"))
    names = set(pictures.PICTURES) - {"option_lam", "option_stride", "option_n_iter"}  # drawn as option_mu is
    pictures.main([*names, "--smoke", "--out", str(tmp_path)])
    assert {path.stem for path in tmp_path.iterdir()} == names
