"""Drivers, extractors and plane maps by name: found, or refused by file, key and choice."""

from importlib.metadata import entry_points
from pathlib import Path

import pytest

from lscan.acquisition.scan import open_devices
from lscan.config.plugins import find_plugin, find_plugin_or_function, installed
from lscan.config.rigfile import load_rig, parse_rig
from lscan.errors import InputError
from lscan.stripe.extractors.paper import centroid

GROUPS = ("lscan.cameras", "lscan.tracks", "lscan.extractors", "lscan.planemaps")

RIG = """
camera = { driver = "opencv", options = { device = 0 } }
track = { driver = "manual", options = { min_mm = 0, max_mm = 10 } }
"""


@pytest.mark.parametrize("group", GROUPS)
def test_every_name_installed_is_found_and_listed_in_order(group: str) -> None:
    names = sorted(entry_points(group=group).names)
    assert list(installed(group)) == names
    for name in names:
        assert find_plugin(group, name) is not None
    with pytest.raises(InputError, match=f"here: no such .*got 'x'; allowed: {', '.join(names)}"):
        find_plugin(group, "x", where="here")


def test_a_function_of_the_users_needs_no_registering() -> None:
    for name in ("centroid", "lscan.stripe.extractors.paper:centroid"):
        assert find_plugin_or_function("lscan.extractors", name) is centroid


@pytest.mark.parametrize(
    ("code", "name", "reason"),
    [
        ("", "mine:gone", "has no attribute 'gone'"),
        ("def f(:", "mine:f", "invalid syntax"),
        ("raise OSError('two\\nlines')", "mine:f", "two lines"),
        ("f = 1", "mine:f", "allowed: a function"),
        ("", "mine:", "allowed: a name that can be imported"),
        ("", ":f", "allowed: a name that can be imported"),
    ],
)
def test_a_users_extractor_that_fails_is_refused_with_the_rig(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, name: str, reason: str
) -> None:
    module = f"of_{tmp_path.name}"
    (tmp_path / f"{module}.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    name = name.replace("mine", module)
    rig = tmp_path / "rig.toml"
    rig.write_text(f'stripe.extractor = "{name}"\n{RIG}')
    with pytest.raises(InputError) as caught:
        load_rig(rig)
    message = str(caught.value)
    assert message.startswith(f"{rig}: stripe.extractor: no such stripe extractor (got '{name}'")
    assert reason in message
    assert "\n" not in message


@pytest.mark.parametrize("device", ["camera", "track"])
def test_a_driver_no_longer_installed_is_named_with_its_file(device: str) -> None:
    """As when a run folder from another machine is to be gone on with."""
    rig = {"camera": {"driver": "sim"}, "track": {"driver": "sim"}}
    rig_file = parse_rig({**rig, device: {"driver": "gone"}}, source="there.toml", trusted=True)
    message = rf"there\.toml: {device}\.driver: no such {device} driver \(got 'gone'; allowed: "
    with pytest.raises(InputError, match=message), open_devices(rig_file):
        pass
