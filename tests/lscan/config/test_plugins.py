"""Drivers, extractors and plane maps by name: found, or refused by file, key and choice."""

import sys
from functools import singledispatch
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import suite_cases
from command_line import call, refused
from fake_devices import fake_rig
from plugin_packages import install_package

import sim.datasets.plugin
from lscan.acquisition.run import recording_versions
from lscan.acquisition.scan import open_devices
from lscan.benchmark.suiterun import run_suite
from lscan.config.plugins import (
    find_plugin,
    find_plugin_or_function,
    frames_of_others,
    installed,
    others_versions,
    with_package,
)
from lscan.config.rig import load_rig, parse_rig
from lscan.errors import InputError
from lscan.paper.experiment import Chain, chain_versions
from lscan.stripe import extract_stripe
from lscan.stripe.rules import centroid
from lscan.suites import find_suite, suites_found
from lscan.surface.surface import provenance_of

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
    for name in ("centroid", "lscan.stripe.rules:centroid"):
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


@pytest.mark.parametrize(
    ("group", "name"),
    [
        ("lscan.cameras", "sim"),
        ("lscan.tracks", "grbl"),
        ("lscan.extractors", "ml"),
        ("lscan.planemaps", "refractive"),
        ("lscan.boardreaders", "read_board"),
    ],
)
def test_two_plugins_of_a_name_are_refused_by_their_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: str, name: str
) -> None:
    """Which of them was meant is not known; all other names are found as ever."""
    install_package(monkeypatch, tmp_path, "rival", f"[{group}]\n{name} = rival:made\n", "made = 1")
    with pytest.raises(InputError) as caught:
        find_plugin(group, name, where="rig.toml")
    assert str(caught.value).startswith("rig.toml: lscan ")
    assert " and rival 2.0 register a " in str(caught.value)
    assert "uninstall the other" in str(caught.value)
    assert all(find_plugin(group, other) is not None for other in installed(group) if other != name)


def test_two_suites_of_a_name_are_refused_by_their_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("one_suites", "two_suites"):
        entries = f"[lscan.suites]\nsea = {package}\n"
        install_package(monkeypatch, tmp_path / package, package, entries)
    with pytest.raises(InputError, match=r"one_suites 2\.0 and two_suites 2\.0 register a suite"):
        find_suite("sea")
    assert "sea" not in suites_found()


def test_a_broken_plugin_breaks_no_other_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where it is asked for, its package and entry point are named, and no cure for another ill."""
    entries = "".join(
        f"[lscan.{group}]\nbroken = wreck:made\n"
        for group in ("cameras", "tracks", "extractors", "planemaps", "boardreaders")
    )
    entries += "[lscan.suites]\nbroken = wreck\n"
    install_package(monkeypatch, tmp_path, "wreck", entries, "import nowhere_to_be_found")
    suite = tmp_path / "suite"
    suite.mkdir()
    suite_cases.drawn_suite(suite, count=1)
    assert len(run_suite(str(suite), {"extractor": ["max"]}).sums) == 1
    for command in (("suite", "verify", suite), ("suite", "list"), ("devices",)):
        code, _, err = call(capsys, *command)
        assert code == 0, err
    words = ("the package wreck 2.0", "names broken = wreck", "wreck.py line 1", "uninstalled")
    refused(call(capsys, "suite", "show", "broken"), "lscan.suites: ", *words)
    for group in (*GROUPS, "lscan.boardreaders"):
        with pytest.raises(InputError) as caught:
            find_plugin(group, "broken")
        assert all(word in str(caught.value) for word in words)
        assert "lscan[tank]" not in str(caught.value)


def test_what_a_strangers_extractor_raises_names_its_file_and_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The line of its own that was at work, not that of the library it called."""
    code = "import numpy as np\n\ndef found(image, settings, clipped):\n    np.linalg.inv(image)\n"
    code += "\ndef mistyped(image, settings, clipped):\n    return 1 + None\n"
    install_package(monkeypatch, tmp_path, "theirs", "", code)
    settings = fake_rig().rig.stripe
    picture = np.zeros((8, 4), np.uint8)
    for function, said in {
        "found": r"failed: LinAlgError: .* \(.*theirs\.py line 4\)$",
        "mistyped": r"failed: TypeError: .* \(.*theirs\.py line 7\)$",
    }.items():
        named = settings.model_copy(update={"extractor": f"theirs:{function}"})
        with pytest.raises(InputError, match=said):
            extract_stripe(picture, named)


def test_what_is_written_names_the_packages_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run folder, surface, calibration: lscan's own plug-ins add nothing to its version."""
    entries = "[lscan.extractors]\nshiny = theirs:found\n[lscan.planemaps]\nbent = theirs:bent\n"
    entries += "[lscan.cameras]\nraspberry = theirs:camera\n"
    install_package(monkeypatch, tmp_path, "theirs", entries, "found = bent = camera = print")
    assert with_package("lscan.extractors", "shiny") == "shiny (theirs 2.0)"
    assert with_package("lscan.extractors", "theirs:found") == "theirs:found (theirs 2.0)"
    assert with_package("lscan.planemaps", "bent-2") == "bent-2 (theirs 2.0)"
    assert with_package("lscan.planemaps", "graticule-2-norulers") == "graticule-2-norulers"
    assert others_versions("lscan.extractors", "nobody:knows") == {}
    rig = fake_rig().rig
    camera = rig.camera.model_copy(update={"driver": "raspberry"})
    stripe = rig.stripe.model_copy(update={"extractor": "shiny"})
    theirs = rig.model_copy(update={"camera": camera, "stripe": stripe})
    assert recording_versions(theirs) == {**recording_versions(rig), "theirs": "2.0"}

    class Bent:
        name = "bent-2"

        def parameters(self) -> dict[str, float]:
            return {}

    kept = provenance_of(theirs, 3, Bent())  # type: ignore[arg-type]
    assert (kept.extractor, kept.plane_map) == ("shiny (theirs 2.0)", "bent-2 (theirs 2.0)")


@pytest.mark.parametrize("name", ["lscan", "lscan-tank"])
def test_a_plugin_of_pytest_with_our_name_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Pytest itself loads whichever it meets first, and says nothing of the other."""
    install_package(monkeypatch, tmp_path, "rival", f"[pytest11]\n{name} = rival\n")
    with pytest.raises(pytest.UsageError, match=r"lscan .* and rival 2\.0 register a plug-in of"):
        sim.datasets.plugin.pytest_configure()


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("def made(:", "SyntaxError: invalid syntax"),
        ("made = 1 / 0", "ZeroDivisionError: division by zero"),
        ("", "AttributeError: module 'wreck' has no attribute 'made'"),
        ("raise MemoryError('two\\nlines')", "MemoryError: two lines"),
    ],
)
def test_whatever_a_plugin_raises_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, said: str
) -> None:
    install_package(monkeypatch, tmp_path, "wreck", "[lscan.tracks]\nbad = wreck:made\n", code)
    monkeypatch.delitem(sys.modules, "wreck", raising=False)
    with pytest.raises(InputError) as caught:
        find_plugin("lscan.tracks", "bad", where="rig.toml: track.driver")
    start = f"rig.toml: track.driver: cannot be loaded from the package wreck 2.0: {said}"
    assert str(caught.value).startswith(start)
    assert "\n" not in str(caught.value)


def test_a_report_names_the_packages_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of both chains: extractors, and plane maps by their full names."""
    entries = "[lscan.extractors]\nshiny = theirs:found\n"
    install_package(monkeypatch, tmp_path / "a", "theirs", entries)
    install_package(monkeypatch, tmp_path / "b", "bends", "[lscan.planemaps]\nbent = bends:map\n")
    chains = Chain("graticule-2", ("max", "shiny")), Chain("bent-3", ("ml",))
    best = SimpleNamespace(chain=chains[1])
    experiment = SimpleNamespace(chain=chains[0], best=best)
    found = chain_versions(experiment)  # type: ignore[arg-type]
    assert (found["theirs"], found["bends"]) == ("2.0", "2.0")
    assert found.keys() == {"lscan", "python", "numpy", "opencv", "theirs", "bends"}


def test_the_frames_of_an_error_leave_out_python_s_own_files() -> None:
    """Python 3.13 finds resources by such a dispatch; the user's file is the one to look into."""

    @singledispatch
    def raising(_: object) -> None:
        raise ValueError

    with pytest.raises(ValueError) as raised:
        raising(0)
    assert [frame.filename for frame in frames_of_others(raised.value)] == [__file__] * 2
