"""Suites are read as they were written; what is harmed is refused by one line with its name."""

import base64
import hashlib
import json
import shutil
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import suite_cases
from command_line import call
from drawn_examples import examples
from hypothesis import given, strategies as st
from plugin_packages import install_package

import lscan.suites.files
from lscan.errors import InputError
from lscan.files.pictures import encode_picture
from lscan.suites import LightLayers, open_suite, pack_suite, suites_found, verify_suite
from lscan.suites.content import (
    LEAST_DN,
    LINE_TRUTH,
    MANIFEST,
    STEPS,
    layers_of_picture,
    layers_picture,
    manifest_bytes,
    member_sum,
    read_manifest,
    read_table,
)
from lscan.suites.files import write_suite_wheel


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A suite's folder."""
    made = tmp_path_factory.mktemp("suites") / "drawn"
    made.mkdir()
    suite_cases.drawn_suite(made)
    return made


@pytest.fixture(scope="module")
def archive(folder):
    """The same suite as an archive."""
    file = folder.with_suffix(".zip")
    pack_suite(folder, file)
    return file


def test_a_case_is_read_as_it_was_written(folder, archive):
    """The PNGs lose nothing; the truth is written to 1e-5 px."""
    for path in (folder, archive):
        suite = verify_suite(path)
        assert len(suite.content.cases) == 4
        for number, case in enumerate(suite.cases()):
            written = suite_cases.drawn_case(
                number, 150.0 if number % 3 else 30.0, number % 2 == 1, number == 0
            )
            for name in ("picture", "labels", "dark"):
                assert np.array_equal(getattr(case, name), getattr(written, name)), name
            assert case.settings == written.settings
            assert np.array_equal(case.truth.status, written.truth.status)
            np.testing.assert_allclose(
                case.truth.centre_px, written.truth.centre_px, rtol=0, atol=5.1e-6
            )
            assert (case.layers is None) == (written.layers is None)
            if case.layers is not None:
                _assert_rounded(case.layers, written.layers)


def _assert_rounded(layers, exact):
    """Each layer within half a step of the logarithm, on either side."""
    half = 2 ** (0.5 / STEPS) * (1 + 1e-9)
    for name, light in vars(exact).items():
        ratio = (getattr(layers, name) + LEAST_DN) / (light + LEAST_DN)
        assert np.all((1 / half <= ratio) & (ratio <= half)), name


@examples(100)
@given(light=st.lists(st.floats(0, 15_000), min_size=6, max_size=6))
def test_layers_are_kept_to_a_rounding_of_their_logarithm(light):
    """Those of light beyond the last step stay at it; those of a step are kept exactly."""
    layers = LightLayers(*np.reshape(light, (3, 1, 2)))
    kept = layers_of_picture(layers_picture(layers))
    _assert_rounded(kept, layers)
    assert np.array_equal(layers_picture(kept), layers_picture(layers))
    beyond = layers_of_picture(layers_picture(LightLayers(*np.full((3, 1, 1), 1e6))))
    assert 15_600 < beyond.direct[0, 0] < 15_800


@pytest.mark.parametrize("shape", [(48, 160), (47, 160, 3), (48, 160, 4)])
def test_layers_of_another_size_are_refused(folder, tmp_path, shape):
    copy = _harmed(
        folder, tmp_path, "case-000/layers.png", encode_picture(np.zeros(shape, np.uint8), ".png")
    )
    assert "case-000 differ in size" in _refused(copy)


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    """A suite's folder with boards, and the cases that it was written of."""
    made = tmp_path_factory.mktemp("boards")
    return made, suite_cases.board_suite(made)


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """A suite's folder with scans, and the cases that it was written of."""
    made = tmp_path_factory.mktemp("scans")
    return made, suite_cases.scan_suite(made)


def test_a_board_is_read_as_it_was_written(boards):
    """Places to 1e-6 px and, half a unit of the last digit, 5e-5 mm."""
    folder, written = boards
    pack_suite(folder, folder.with_suffix(".zip"))
    for path in (folder, folder.with_suffix(".zip")):
        for case, was in zip(verify_suite(path).boards(), written, strict=True):
            assert (case.name, case.axes, case.board) == (was.name, was.axes, was.board)
            assert case.optics == was.optics
            assert np.array_equal(case.picture, was.picture)
            for one, other, atol in (
                (case.marks.board_mm, was.marks.board_mm, 5.1e-5),
                (case.marks.image_px, was.marks.image_px, 1e-6),
                (case.marks.sigma_px, was.marks.sigma_px, 1e-6),
                (case.map_px, was.map_px, 1e-6), (case.map_mm, was.map_mm, 5.1e-5),
            ):  # fmt: skip
                np.testing.assert_allclose(one, other, rtol=0, atol=atol)
            assert np.array_equal(case.marks.status, was.marks.status)


def test_a_scan_is_read_as_it_was_written(scans):
    """Places to half a unit of the last of four digits."""
    folder, written = scans
    pack_suite(folder, folder.with_suffix(".zip"))
    for path in (folder, folder.with_suffix(".zip")):
        for case, was in zip(verify_suite(path).scans(), written, strict=True):
            assert (case.name, case.axes, case.rig) == (was.name, was.axes, was.rig)
            assert case.board.axes == case.axes
            assert np.array_equal(case.frames, was.frames)
            for name in ("multiple", "status", "slice_status"):
                assert np.array_equal(getattr(case, name), getattr(was, name)), name
            for name in ("line_mm", "height_dn", "slices_mm"):
                one, other = getattr(case, name), getattr(was, name)
                np.testing.assert_allclose(one, other, rtol=0, atol=5.1e-5)


MARKS_HEAD, MAP_HEAD = b"x_mm,z_mm,u_px,v_px,status\n", b"u_px,v_px,x_mm,z_mm\n"
LINE_HEAD, SLICES_HEAD = b"x_mm,z_mm,height_dn,multiple,status\n", b"x_mm,y_mm,z_mm,status\n"


@pytest.mark.parametrize(
    ("member", "content", "said"),
    [
        ("board-000/map.csv", b"u_px,v_px\n", "no table of u_px, v_px, x_mm, z_mm"),
        ("board-000/map.csv", MAP_HEAD, "no table of a map"),
        ("board-000/map.csv", MAP_HEAD + b"1,1,nan,1\n", "no table of a map"),
        ("board-000/truth.csv", MARKS_HEAD, "differ in marks"),
        ("board-000/truth.csv", MARKS_HEAD + b"1,1,nan,1,0\n", "no table of marks"),
        ("board-000/truth.csv", MARKS_HEAD + b"1,1,1,1,99\n", "no table of marks"),
        ("board-000/board.json", b"{}", "board.json: grid: field required"),
        ("board-000/optics.json", b"[]", "optics.json: document: must be a table"),
        ("board-000/picture.png", b"none", "is not an 8- or 16-bit"),
        ("scan-000/line.csv", LINE_HEAD, "differ in size"),
        ("scan-000/line.csv", LINE_HEAD + b"1,nan,1,0,0\n" * 160, "no table of a scan's truth"),
        ("scan-000/line.csv", LINE_HEAD + b"1,1,1,2,0\n" * 160, "no table of a scan's truth"),
        ("scan-000/line.csv", LINE_HEAD + b"1,1,1,0,99\n" * 160, "no table of a scan's truth"),
        ("scan-000/slices.csv", SLICES_HEAD + b"nan,1,1,7\n", "no table of a scan's truth"),
        ("scan-000/rig.json", b"[]", "rig.json: document: must be a table"),
        ("scan-000/rig.json", b"{", "rig.json: is not valid JSON"),
        ("scan-000/rig.json", b'{"camera": {}}', "camera.driver"),
        ("scan-000/frame-0001.png", b"none", "is not an 8- or 16-bit"),
        ("scan-000/picture.png", b"none", "is not an 8- or 16-bit"),
    ],
)
def test_a_harmed_board_or_scan_is_refused_by_its_member(
    boards, scans, tmp_path, member, content, said
):
    """Though the manifest has the checksum of what is there."""
    folder, _ = boards if member.startswith("board") else scans
    assert said in _refused(_harmed(folder, tmp_path, member, content))


def test_a_scan_that_lacks_a_picture_is_refused(scans, tmp_path):
    copy = _harmed(scans[0], tmp_path, "scan-000/frame-0001.png", None)
    assert "member scan-000/frame-0001.png is missing" in _refused(copy)


def test_an_archive_has_the_same_bytes_each_time(folder, archive, tmp_path):
    again = tmp_path / "again.zip"
    pack_suite(folder, again)
    assert again.read_bytes() == archive.read_bytes()


def _harmed(folder, tmp_path, member, content):
    """A copy of the suite one of whose members is other, and has the checksum of what is there.

    content: bytes, None for one that the manifest does not have.
    """
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    of = open_suite(copy).content
    members = dict(of.members)
    if content is None:
        del members[member]
    else:
        (copy / member).write_bytes(content)
        members[member] = member_sum(content)
    (copy / MANIFEST).write_bytes(manifest_bytes(of.model_copy(update={"members": members})))
    return copy


def _refused(path):
    with pytest.raises(InputError) as refused:
        verify_suite(path)
    message = str(refused.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@examples(60)
@given(data=st.data())
def test_harmed_archives_are_refused(archive, tmp_path_factory, data):
    """Any bit flipped, any cut, anything appended."""
    content = bytearray(archive.read_bytes())
    how = data.draw(st.sampled_from(["flip", "cut", "append"]))
    place = data.draw(st.integers(0, len(content) - 1))
    if how == "flip":
        content[place] ^= 1 << data.draw(st.integers(0, 7))
    elif how == "cut":
        del content[place:]
    else:
        content += b"x" * (1 + place % 7)
    file = tmp_path_factory.getbasetemp() / "harmed.zip"
    file.write_bytes(content)
    _refused(file)


@examples(30)
@given(data=st.data())
def test_a_harmed_member_of_a_folder_is_named(folder, data):
    names = sorted(open_suite(folder).content.members)
    name = data.draw(st.sampled_from(names))
    file = folder / name
    whole = file.read_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    try:
        harmed = bytearray(whole)
        harmed[place] ^= 1 << data.draw(st.integers(0, 7))
        file.write_bytes(harmed)
        assert name in _refused(folder)
        file.write_bytes(whole[:place])
        assert name in _refused(folder)
    finally:
        file.write_bytes(whole)


def test_truth_that_is_another_and_still_truth_is_refused(folder, tmp_path):
    """As a program or a person may change a digit: the table can be read all the same."""
    copy = tmp_path / "changed"
    shutil.copytree(folder, copy)
    file = next(copy.glob("*/truth.csv"))
    text = file.read_text()
    digit = text.index(".") + 1
    file.write_text(f"{text[:digit]}{(int(text[digit]) + 1) % 10}{text[digit + 1 :]}")
    assert f"{file.parent.name}/truth.csv is not what the manifest says" in _refused(copy)


def _forged(folder, tmp_path, change):
    """A copy of the suite whose manifest is changed, with a right checksum of its own."""
    copy = tmp_path / "forged"
    shutil.copytree(folder, copy)
    content = open_suite(folder).content
    (copy / MANIFEST).write_bytes(manifest_bytes(change(content)))
    return copy


def test_another_version_is_refused(folder, tmp_path):
    path = _forged(folder, tmp_path, lambda content: content.model_copy(update={"version": 1}))
    assert "of another version (got 1; allowed: 3; lscan-sim suite make" in _refused(path)


@pytest.mark.parametrize(
    "name", ["../secret", "/etc/passwd", "a/../../b", "a\\b/c", "A/b", "a/b\n"]
)
def test_a_member_outside_of_the_suite_is_refused(folder, tmp_path, name):
    def change(content):
        stated = next(iter(content.members.values()))
        return content.model_copy(update={"members": {**content.members, name: stated}})

    assert "a name that is not plain" in _refused(_forged(folder, tmp_path, change))


def test_a_link_out_of_the_folder_is_refused(folder, tmp_path):
    copy = tmp_path / "linked"
    shutil.copytree(folder, copy)
    file = copy / "case-000" / "truth.csv"
    (tmp_path / "truth.csv").write_bytes(file.read_bytes())
    file.unlink()
    file.symlink_to(tmp_path / "truth.csv")
    assert "link that leads out" in _refused(copy)


def test_a_compressed_archive_is_refused(folder, tmp_path):
    """A member that unpacks to more than the file holds: a bomb."""
    bomb = tmp_path / "bomb.zip"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(MANIFEST, bytes(2**24))
    assert f"member {MANIFEST} is compressed" in _refused(bomb)


@examples(50)
@given(st.binary(max_size=200))
def test_what_is_no_manifest_and_no_truth_is_refused(data):
    for read in (read_manifest, partial(read_table, LINE_TRUTH)):
        with pytest.raises(InputError):
            read(data, "here")


@pytest.mark.parametrize(
    "row", ["nan,1,1,1,0,0", "1,1,1,1,0,99", "1,1,1,1,2,0", "1,1,1,1,nan,0", "1,1,1,1,0,1e99"]
)
def test_impossible_truth_is_refused(row):
    data = f"{LINE_TRUTH.columns}\n{row}\n".encode()
    with pytest.raises(InputError, match="no table of a line's truth"):
        read_table(LINE_TRUTH, data, "here")


def test_suites_are_found_in_the_cache(archive, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "lscan" / "suites").mkdir(parents=True)
    shutil.copy(archive, tmp_path / "lscan" / "suites")
    assert suites_found() == {"drawn": tmp_path / "lscan" / "suites" / "drawn.zip"}
    for command, said in {
        "list": "drawn: ",
        "show drawn": "drawn: 4 cases, seed 7",
        "verify drawn": "4 cases and 19 members are whole",
    }.items():
        code, out, _ = call(capsys, "suite", *command.split())
        assert (code, said in out) == (0, True), out


def test_suites_are_found_by_entry_point(folder, tmp_path, monkeypatch):
    """A package of another distribution names itself; the suite lies in it."""
    package = tmp_path / "somebodys"
    package.mkdir()
    (package / "__init__.py").touch()
    pack_suite(folder, package / "theirs.zip")
    install_package(monkeypatch, tmp_path, "somebodys", "[lscan.suites]\ntheirs = somebodys\n")
    assert suites_found()["theirs"] == package / "theirs.zip"
    with pytest.raises(InputError, match="no such suite"):
        lscan.suites.files.find_suite("nobodys")


def test_a_wheel_has_the_same_bytes_and_states_what_it_holds(archive, tmp_path, capsys):
    """Each member's checksum and size as RECORD has them; names and versions normalised."""
    options = ["suite", "wheel", archive, "--name", "My-Suites", "--version", "1.2", "--json"]
    code, out, _ = call(capsys, *options, "-o", tmp_path / "one")
    assert code == 0
    wheel = Path(json.loads(out)["wheel"])
    assert wheel.name == "my_suites-1.2-py3-none-any.whl"
    again = write_suite_wheel([archive], tmp_path / "two", "My-Suites", "1.2")
    assert again.read_bytes() == wheel.read_bytes()
    with zipfile.ZipFile(wheel) as file:
        members = {name: file.read(name) for name in file.namelist()}
    assert members["my_suites/drawn.zip"] == archive.read_bytes()
    rows = members.pop("my_suites-1.2.dist-info/RECORD").decode().splitlines()
    stated = {path: (checksum, size) for path, checksum, size in (row.split(",") for row in rows)}
    for name, data in members.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
        assert stated.pop(name) == (f"sha256={digest}", str(len(data)))
    assert stated == {"my_suites-1.2.dist-info/RECORD": ("", "")}


@pytest.mark.parametrize(
    ("name", "version", "said"),
    [
        ("../evil", "1.0", "no name of a package"),
        ("-x", "1.0", "no name of a package"),
        ("a" * 101, "1.0", "no name of a package"),
        ("suites", "1.0\n[console_scripts]", "no version of a package"),
        ("suites", "latest", "no version of a package"),
        ("lscan", "1.0", "the name of another package"),
        ("NumPy", "1.0", "the name of another package"),
    ],
)
def test_a_wheel_of_a_bad_name_or_version_is_refused(archive, tmp_path, name, version, said):
    with pytest.raises(InputError, match=said):
        write_suite_wheel([archive], tmp_path, name, version)
    assert not list(tmp_path.glob("*.whl"))


def test_a_wheel_of_harmed_or_equal_suites_is_refused(folder, archive, tmp_path):
    harmed = tmp_path / "harmed.zip"
    harmed.write_bytes(archive.read_bytes()[:-30])
    for archives, said in (
        ([harmed], "is no suite"), ([archive, archive], "two suites have one name"),
        ([folder], "is a folder"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            write_suite_wheel(archives, tmp_path / "dist", "suites", "1.0")
