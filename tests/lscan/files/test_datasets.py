"""Run lengths of masks against a count pixel by pixel; data sets that are harmed."""

import json
from pathlib import Path

import numpy as np
import pytest

from lscan.errors import InputError
from lscan.files.datasets import PictureDataset, run_lengths


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95, 1.0])
def test_run_lengths_count_pixels_column_by_column(share: float) -> None:
    generator = np.random.default_rng(16)
    for shape in ((1, 1), (7, 5), (1, 40), (48, 64)):
        mask = generator.random(shape) < share
        counts, inside = [0], False
        for u in range(shape[1]):
            for v in range(shape[0]):
                if bool(mask[v, u]) != inside:
                    counts.append(0)
                    inside = not inside
                counts[-1] += 1
        found = run_lengths(mask)
        assert found == {"size": list(shape), "counts": counts}
        assert json.loads(json.dumps(found)) == found


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[]", "is no manifest"),
        ("{", "is not valid JSON"),
        ('{"version": 99, "shards": []}', "of another version"),
        ('{"version": 1}', "is no manifest"),
    ],
)
def test_what_is_no_manifest_is_refused(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "manifest.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=why):
        PictureDataset(tmp_path)


def test_a_shard_outside_the_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (tmp_path / "out.tar").write_bytes(b"")
    shards = [{"file": "../out.tar", "sha256": "", "keys": ["000000000"]}]
    text = json.dumps({"version": 1, "shards": shards})
    (folder / "manifest.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError):
        PictureDataset(folder)[0]
