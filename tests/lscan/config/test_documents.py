"""TOML documents: includes, merging, and the message for a wrong file."""

from pathlib import Path

import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES

from lscan.camera.posedboards import LIMITS
from lscan.config.board import Grid, load_board
from lscan.config.documents import MOST_FILES, by_content, check, merge, named_files, read_document
from lscan.config.rig import CameraSection, OpticsSection, Rig, SheetSection
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError
from lscan.files.disk import read_json

TABLES = st.recursive(
    st.integers() | st.text(max_size=3),
    lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
    max_leaves=8,
).filter(lambda value: isinstance(value, dict))


@examples(100)
@given(a=TABLES, b=TABLES)
def test_merging_keeps_every_key_and_the_later_wins(a: dict, b: dict) -> None:
    assert merge(a, {}) == merge({}, a) == a
    assert merge(a, a) == a
    merged = merge(a, b)
    assert all(merged[key] == b[key] for key in b if not isinstance(b[key], dict))
    assert set(merged) == set(a) | set(b)


def test_a_file_wins_over_what_it_includes(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text("a = 1\n[t]\nx = 1\ny = 1\n")
    (tmp_path / "more.toml").write_text("[t]\ny = 2\n")
    (tmp_path / "top.toml").write_text('include = ["base.toml", "more.toml"]\n[t]\nz = 3\n')
    assert read_document(tmp_path / "top.toml") == {"a": 1, "t": {"x": 1, "y": 2, "z": 3}}


def test_what_is_included_can_be_excluded(tmp_path: Path) -> None:
    """A table or a key of one; what the file itself says of it then stands alone."""
    (tmp_path / "base.toml").write_text("a = 1\n[t]\nx = 1\ny = 1\n[u]\nz = 1\n[u.v]\nw = 1\n")
    (tmp_path / "middle.toml").write_text('include = "base.toml"\nexclude = "t.x"\n')
    assert read_document(tmp_path / "middle.toml") == {
        "a": 1, "t": {"y": 1}, "u": {"z": 1, "v": {"w": 1}},
    }  # fmt: skip
    (tmp_path / "top.toml").write_text(
        'include = "middle.toml"\nexclude = ["a", "t", "u.v"]\n[t]\nnew = 2\n'
    )
    assert read_document(tmp_path / "top.toml") == {"t": {"new": 2}, "u": {"z": 1}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('exclude = ["b"]', r"exclude: .*got 'b'; allowed: a, t; a key of a table as table\.key"),
        ('exclude = ["t.y"]', r"exclude: .*got 't\.y'"),
        ('exclude = ["a.x"]', r"exclude: .*got 'a\.x'"),
        ('exclude = ["a", "a"]', "exclude: .*got 'a'; allowed: t;"),
        ("exclude = 3", "bad exclude .*got 3; allowed: a dotted key or a list"),
        ('exclude = [""]', "bad exclude"),
        ('[t]\nz = 1\n[exclude]\nt = "x"', "bad exclude"),
    ],
)
def test_what_is_not_included_cannot_be_excluded(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "base.toml").write_text("a = 1\n[t]\nx = 1\n")
    (tmp_path / "top.toml").write_text(f'include = "base.toml"\n{text}\n')
    with pytest.raises(InputError, match=message) as caught:
        read_document(tmp_path / "top.toml")
    assert str(caught.value).startswith(str(tmp_path / "top.toml"))


def test_without_an_include_there_is_nothing_to_exclude(tmp_path: Path) -> None:
    (tmp_path / "top.toml").write_text('exclude = ["t"]\n[t]\nx = 1\n')
    with pytest.raises(InputError, match=r"exclude: .*nothing, for the file includes none"):
        read_document(tmp_path / "top.toml")


def test_paths_hold_from_anywhere(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "inner.toml").write_text('[m]\nfile = "mesh.ply"\n')
    (tmp_path / "top.toml").write_text('include = "sub/inner.toml"\n')
    read = read_document(tmp_path / "top.toml")
    assert read["m"]["file"] == str(tmp_path / "sub" / "mesh.ply")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"\xff\xfe", "not UTF-8"),
        (b"a = ", "not valid TOML"),
        (b"include = 5", "bad include.*5"),
        (b'include = "gone.toml"', r"gone\.toml.*cannot be read"),
        (b'include = ["top.toml"]', "includes itself"),
        (b"a = " + b"9" * 5000, "not valid TOML: .*5000 digits"),
        (b"a = 1979-13-45", "not valid TOML"),
        (b'a = "x\0y"', "not valid TOML: Illegal character"),
        (b'a = "x\\u0000y"', r"a: holds a null character \(got 'x\\x00y'; allowed: a text without"),
        (b'a.b = [1, {c = "\\u0000"}]', r"a\.b\.1\.c: holds a null character"),
        (b'a = {"\\u0000" = 1}', r"a: holds a null character"),
        (b'include = "\\u0000"', "include: holds a null character"),
        (b'm = {file = ""}', r"m\.file: must be a text that is a path.*''"),
        (b"a = " + b"[" * 5000 + b"]" * 5000, "too deep.*allowed: 50 levels"),
        (b"a = " + b"{a=" * 5000 + b"1" + b"}" * 5000, "too deep.*allowed: 50 levels"),
        (b".".join([b"a"] * 5000) + b" = 1", r"a\.a\.a\.\.\.: .*too deep.*allowed: 50 levels"),
        (b"[" + b".".join([b"a"] * 5000) + b"]", r"a\.a\.a\.\.\.: .*too deep"),
        (b"a = { " + b" . ".join([b'"a"', b"'b'"] * 26) + b" = 1 }", r"too deep"),
        (b"a = " + b"[" * 50 + b"]" * 50, "too deep"),
    ],
)
def test_unreadable_documents_are_named(tmp_path: Path, text: bytes, message: str) -> None:
    (tmp_path / "top.toml").write_bytes(text)
    with pytest.raises(InputError, match=message) as caught:
        read_document(tmp_path / "top.toml")
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def include(path: Path, *names: str) -> None:
    path.write_text(f"include = {list(names)}\n")


def test_includes_as_deep_as_the_limit_are_read_and_no_deeper(tmp_path: Path) -> None:
    for depth in range(MOST_FILES):
        include(tmp_path / f"{depth}.toml", f"{depth + 1}.toml")
    (tmp_path / f"{MOST_FILES}.toml").write_text("a = 1\n")
    assert read_document(tmp_path / "0.toml") == {"a": 1}
    include(tmp_path / f"{MOST_FILES}.toml", "end.toml")
    (tmp_path / "end.toml").write_text("a = 1\n")
    with pytest.raises(InputError, match=r"0\.toml: includes too many files \(allowed: 100 "):
        read_document(tmp_path / "0.toml")


def test_includes_that_double_at_every_level_are_refused(tmp_path: Path) -> None:
    """Forty files of a line each would be read a million million times."""
    for depth in range(40):
        include(tmp_path / f"{depth}.toml", f"{depth + 1}.toml", f"{depth + 1}.toml")
    (tmp_path / "40.toml").write_text("a = 1\n")
    with pytest.raises(InputError, match=r"0\.toml: includes too many files"):
        read_document(tmp_path / "0.toml")


def test_files_that_include_one_another_are_refused(tmp_path: Path) -> None:
    include(tmp_path / "a.toml", "b.toml")
    include(tmp_path / "b.toml", "c.toml")
    (tmp_path / "c.toml").symlink_to("a.toml")
    with pytest.raises(InputError, match=r"a\.toml: includes itself \(got \['a\.toml', 'b\.toml"):
        read_document(tmp_path / "a.toml")


def test_a_path_through_a_loop_of_links_is_left_to_its_reader(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "top.toml").write_text('m = { file = "loop/mesh.ply" }\n')
    assert read_document(tmp_path / "top.toml")["m"]["file"] == str(tmp_path / "loop" / "mesh.ply")


def test_what_only_looks_like_a_deep_key_is_read(tmp_path: Path) -> None:
    numbers = ", ".join(["1.5"] * 60)
    words = ". ".join(["word and"] * 60)
    (tmp_path / "a.toml").write_text(f'# {words}...\na = [{numbers}]\nb = "{words}"\n')
    assert read_document(tmp_path / "a.toml") == {"a": [1.5] * 60, "b": words}


def test_nesting_within_the_limit_and_numbers_of_thousands_of_digits_are_read(
    tmp_path: Path,
) -> None:
    """Whether a model can hold such a number is for the model to say."""
    file = tmp_path / "top.toml"
    file.write_text("a = " + "[" * 49 + "]" * 49 + "\nb = 1" + "0" * 4000 + "\n")
    assert read_document(file)["b"] == 10**4000
    number = {"driver": "none", "exposure_ms": 10**4000}
    with pytest.raises(InputError, match=r"top: camera\.exposure_ms: must be a number above 0"):
        check(CameraSection, number, where="top", prefix="camera")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": 2}, r"grid\.rows.*2"),
        ({"rows": 3.0}, r"grid\.rows: must be a whole number.*3\.0"),
        ({"pitch_mm": "50"}, r"grid\.pitch_mm: must be a number.*'50'"),
        ({"pitch_mm": float("inf")}, r"grid\.pitch_mm"),
        ({"dot_diameter_mm": 60.0}, "smaller than pitch_mm"),
        ({"colour": 1}, r"grid\.colour: unknown key"),
    ],
)
def test_every_fault_of_a_model_is_one_line(change: dict, message: str) -> None:
    good = {"columns": 4, "rows": 4, "pitch_mm": 50.0, "dot_diameter_mm": 5.0}
    assert check(Grid, good, where="x").columns == 4
    with pytest.raises(InputError, match=message) as caught:
        check(Grid, good | change, where="board.toml", prefix="grid")
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("board.toml: ")


def test_the_papers_board_has_the_papers_lengths() -> None:
    """Tables I and II, as printed: lengths in mm to two decimals."""
    scenes = SCENES / "paper"
    board = load_board(scenes / "calibration-board.toml")
    lengths = [round(board.distance_mm(*pair), 2) for pair in board.distances]
    assert lengths == [80, 89.44, 40, 60, 30, 60, 30, 25, 25, 25, 25, 40, 50, 30]
    assert {ring.name: ring.diameter_mm for ring in board.ring} == {"E": 28.4, "F": 49.2, "G": 49.2}
    assert all(ring.width_mm == 0.8 for ring in board.ring)


def test_the_grooved_block_carries_all_nine_dimensions() -> None:
    """Table III's nominal values from the outline itself, not from the record's fields."""
    block = GroovedBlock()
    outline = block.outline_mm()
    x, z = outline.T
    edges = block.edges_mm()
    dimensions = block.dimensions_mm()
    assert z.max() == dimensions["H2"] == 80.06
    bottoms = [z[(x == edges[1 + 2 * k]) & (z < z.max())].max() for k in range(3)]
    depths = z.max() - bottoms
    assert depths == pytest.approx([dimensions["H3"], dimensions["H4"], dimensions["H1"]])
    assert edges[5] - edges[0] == pytest.approx(154.96)
    assert edges[6] - edges[2] == pytest.approx(131.04)


def test_the_sandwave_fits_the_papers_text() -> None:
    """Four wavelengths, one meander, amplitude 1.5 to about 8 mm (docs/explanation/physics.md)."""
    piece = Sandwave()
    assert piece.side_mm * piece.c_per_mm / (2 * 3.14159265) == pytest.approx(4, abs=0.02)
    assert piece.side_mm * piece.e_per_mm / (2 * 3.14159265) == pytest.approx(1, abs=0.01)
    assert piece.a_mm + piece.b * piece.side_mm == pytest.approx(8, abs=0.06)
    assert piece.side_mm + 2 * piece.rim_mm == 210


@pytest.mark.parametrize(
    ("piece", "message"),
    [
        ({"kind": "grooved-block", "colour": 1}, r": workpiece\.colour: unknown key"),
        ({"colour": 1}, r": workpiece\.kind: field required"),
        ({"kind": "sphere"}, r": workpiece\.kind: no such kind \(got 'sphere'; allowed: 'gr"),
    ],
)
def test_a_fault_names_the_keys_of_the_file_alone(piece: dict, message: str) -> None:
    devices = {"camera": {"driver": "replay"}, "track": {"driver": "replay"}}
    with pytest.raises(InputError, match=message):
        check(Rig, {**devices, "workpiece": piece}, where="rig.toml")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("focal_px", [0.0, 10.0]),
        ("focal_px", [1e9, 0.0]),
        ("centre_u_px", [1e6, 1.0]),
        ("gap_mm", [-10.0, 1.0]),
        ("thickness_mm", [-5.0, 0.0]),
        ("glass_index", [0.9, 0.0]),
        ("water_index", [5.0, 0.0]),
        ("tilt_x_deg", [89.0, 0.0]),
    ],
)
def test_optics_out_of_range_are_refused_before_a_scan(key: str, value: list[float]) -> None:
    with pytest.raises(InputError, match=rf"rig\.toml: optics\.{key}\.0: .*got {value[0]}"):
        check(OpticsSection, {key: value}, where="rig.toml", prefix="optics")


def test_the_fit_of_a_view_may_go_wherever_a_rig_file_may_begin() -> None:
    for name, (low, high) in LIMITS.items():
        for value in (low, min(high, 1e4)):
            check(OpticsSection, {name: [value, 0.0]}, where="rig.toml")


def test_a_document_by_content_knows_files_by_what_they_hold(tmp_path: Path) -> None:
    """Also a board's file by those that it includes, and a folder by its own files."""
    folder = tmp_path / "run"
    folder.mkdir()
    held = {"mesh.stl": "a", "base.toml": "a = 1", "board.toml": 'include = "base.toml"\n'}
    held |= {"run/frames.csv": "0"}

    def found() -> object:
        for name, text in held.items():
            (tmp_path / name).write_text(text, encoding="utf-8")
        files = [{"file": str(tmp_path / name)} for name in ("mesh.stl", "board.toml")]
        options = {"run_file": str(folder), "port": str(tmp_path / "mesh.stl")}
        document = {"target": files, "camera": {"options": options}}
        assert list(named_files(document)) == [*(one["file"] for one in files), str(folder)]
        return by_content(document)

    before = found()
    assert str(tmp_path / "mesh.stl") in str(before)  # a port, whatever lies there
    for name in ("mesh.stl", "base.toml", "run/frames.csv"):
        again, held[name] = found(), f"{held[name]}1"
        assert found() != again, name
    assert named_files({"file": str(tmp_path / "gone")}) == {str(tmp_path / "gone"): ""}


def test_other_faults_are_named_by_their_keys() -> None:
    """One message names all that must be corrected, as far as one line holds it."""
    with pytest.raises(InputError, match=r"sheet\.thickness_mm: .*; see also sheet\.apex_mm"):
        check(SheetSection, {"camera_mm": [0.0, -900.0, 300.0]}, where="rig.toml", prefix="sheet")


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path: Path, mark: str) -> None:
    """As Windows' editors write it: in TOML, in what it includes, and in JSON."""
    (tmp_path / "base.toml").write_text(f"{mark}a = 1\n", encoding="utf-8")
    (tmp_path / "a.toml").write_text(f'{mark}include = "base.toml"\nb = 2\n', encoding="utf-8")
    (tmp_path / "a.json").write_text(f'{mark}{{"a": 1}}', encoding="utf-8")
    assert read_document(tmp_path / "a.toml") == {"a": 1, "b": 2}
    assert read_json(tmp_path / "a.json") == {"a": 1}


@pytest.mark.parametrize("coding", ["utf-16", "utf-16-be"])
def test_a_text_in_utf_16_is_said_to_be_one(tmp_path: Path, coding: str) -> None:
    """As PowerShell writes what is redirected to a file."""
    text = "a = 1" if coding == "utf-16" else "\ufeffa = 1"
    (tmp_path / "a.toml").write_text(text, encoding=coding)
    with pytest.raises(InputError, match=r"a\.toml: is not UTF-8 text \(got 'UTF-16; save it as"):
        read_document(tmp_path / "a.toml")
