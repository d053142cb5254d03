"""Clouds for other programs: where the points are, in which unit, and how good they are."""

import struct
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import laspy
import numpy as np
import pytest
from typer.testing import CliRunner

from lscan.cli.app import app
from lscan.errors import InputError
from lscan.records import Floats, Status, Surface, has_value
from lscan.surface import save_points


def scanned() -> Surface:
    """Points of a tank's size; a profile without values, one that is clipped, a point not lit."""
    rng = np.random.default_rng(60)
    shape = (20, 30)
    xyz = np.stack([rng.uniform(-150.0, high, shape) for high in (150.0, 900.0, -20.0)], axis=-1)
    status = np.full(shape, int(Status.OK))
    status[3], status[5] = Status.SATURATED, Status.OCCLUDED
    xyz[5] = np.nan
    brightness = rng.uniform(10.0, 4000.0, shape)
    brightness[0, 0], brightness[0, 1] = np.nan, 70_000.0
    sigma_x, sigma_z = rng.uniform(0.005, 0.1, (2, *shape))
    return Surface(xyz, sigma_x, sigma_z, status, np.arange(20.0), brightness=brightness)


SURFACE = scanned()
THERE = SURFACE.status != Status.OCCLUDED
POINTS, STATUS = SURFACE.xyz_mm[THERE], SURFACE.status[THERE]


def las_read(path: Path) -> tuple[dict[str, Floats], dict[str, bytes]]:
    """Fields of the points and of the header, after the specification (1.4-R15) alone."""
    content = path.read_bytes()
    assert content[:4] == b"LASF" and content[24:26] == bytes([1, 4])
    assert content[90:94] == bytes(4)  # no date
    (encoding,) = struct.unpack_from("<H", content, 6)
    assert encoding == 0b10000  # the coordinate system is in WKT
    head, begin, records = struct.unpack_from("<HII", content, 94)
    kind, length = struct.unpack_from("<BH", content, 104)
    scale, offset = np.frombuffer(content, "<f8", 6, 131).reshape(2, 3)
    bounds = np.frombuffer(content, "<f8", 6, 179).reshape(3, 2)  # max, min of x, of y, of z
    (count,) = struct.unpack_from("<Q", content, 247)
    assert (head, kind) == (375, 6) and len(content) == begin + count * length
    fields = {"intensity": ("<u2", 12), "returns": ("u1", 14)}
    at, beyond, texts = head, 30, {"system": content[26:58].rstrip(b"\0")}
    for _ in range(records):
        user, record, size = struct.unpack_from("<2x16sHH", content, at)
        body = content[at + 54 : at + 54 + size]
        if (user.rstrip(b"\0"), record) == (b"LASF_Projection", 2112):
            texts["wkt"] = body.rstrip(b"\0")
        if (user.rstrip(b"\0"), record) == (b"LASF_Spec", 4):
            for one in range(0, size, 192):
                form, name = {1: "u1", 9: "<f4"}[body[one + 2]], body[one + 4 : one + 36]
                fields[name.rstrip(b"\0").decode()] = (form, beyond)
                beyond += np.dtype(form).itemsize
        at += 54 + size
    assert beyond == length
    fields |= {axis: ("<i4", 4 * place) for place, axis in enumerate("xyz")}
    names, parts = zip(*fields.items(), strict=True)
    forms, places = zip(*parts, strict=True)
    point = np.dtype({"names": names, "formats": forms, "offsets": places, "itemsize": length})
    points = np.frombuffer(content, point, count, begin)
    read = {name: points[name].astype(float) for name in names}
    for place, axis in enumerate("xyz"):
        read[axis] = read[axis] * scale[place] + offset[place]
        assert tuple(bounds[place]) == (read[axis].max(), read[axis].min())
    return read, texts


def test_las_holds_tenths_of_a_micrometre_in_metres(tmp_path: Path) -> None:
    save_points(tmp_path / "cloud.las", SURFACE)
    read, texts = las_read(tmp_path / "cloud.las")
    xyz = np.stack([read[axis] for axis in "xyz"], axis=-1)
    np.testing.assert_allclose(xyz, POINTS / 1000, rtol=0, atol=0.5001e-7)
    assert texts["system"] == b"lscan, head frame"
    assert texts["wkt"].startswith(b'LOCAL_CS["head frame"') and b'UNIT["metre",1]' in texts["wkt"]
    for axis, sigma in (("x", SURFACE.sigma_x_mm), ("z", SURFACE.sigma_z_mm)):
        np.testing.assert_allclose(read[f"sigma_{axis}"], sigma[THERE] / 1000, rtol=1e-7)
    assert "sigma_y" not in read  # y is the track's, taken for exact
    np.testing.assert_array_equal(read["status"], STATUS)
    assert (read["returns"] == 0x11).all()  # the first of one, as the specification asks for
    assert tuple(read["intensity"][:2]) == (0, 65535)
    assert SURFACE.brightness is not None
    np.testing.assert_allclose(read["intensity"][2:], SURFACE.brightness[THERE][2:], atol=0.5001)


def test_las_has_what_a_workpiece_surface_knows(tmp_path: Path) -> None:
    sigma_y = 2 * SURFACE.sigma_z_mm
    aligned = replace(SURFACE, frame="workpiece", sigma_y_mm=sigma_y, brightness=None)
    save_points(tmp_path / "cloud.las", aligned)
    read, texts = las_read(tmp_path / "cloud.las")
    np.testing.assert_allclose(read["sigma_y"], sigma_y[THERE] / 1000, rtol=1e-7)
    assert texts["system"] == b"lscan, workpiece frame"
    assert not read["intensity"].any()


def test_a_long_track_far_away_is_counted_from_its_middle(tmp_path: Path) -> None:
    far = SURFACE.xyz_mm + np.array([0.0, 5e6, 0.0])
    save_points(tmp_path / "far.las", replace(SURFACE, xyz_mm=far))
    near, _ = las_read(tmp_path / "far.las")
    np.testing.assert_allclose(near["y"], far[THERE][:, 1] / 1000, rtol=0, atol=0.501e-7)
    far[0, 0, 1] -= 2e6  # 2 km of track
    save_points(tmp_path / "far.las", replace(SURFACE, xyz_mm=far))
    long, _ = las_read(tmp_path / "far.las")
    np.testing.assert_allclose(long["y"], far[THERE][:, 1] / 1000, rtol=0, atol=0.501e-6)


def test_laz_is_the_same_packed(tmp_path: Path) -> None:
    save_points(tmp_path / "cloud.las", SURFACE)
    save_points(tmp_path / "cloud.laz", SURFACE)
    packed = (tmp_path / "cloud.laz").read_bytes()
    plain, unpacked = laspy.read(tmp_path / "cloud.las"), laspy.read(tmp_path / "cloud.laz")
    np.testing.assert_array_equal(unpacked.points.array, plain.points.array)
    assert len(packed) < (tmp_path / "cloud.las").stat().st_size
    save_points(tmp_path / "cloud.laz", SURFACE)
    assert (tmp_path / "cloud.laz").read_bytes() == packed


def test_ply_names_the_uncertainty_as_meshlab_does_too(tmp_path: Path) -> None:
    save_points(tmp_path / "cloud.ply", SURFACE)
    head, _, body = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[2].endswith("head frame, mm") and lines[3] == f"element vertex {len(POINTS)}"
    forms = {"float": "<f4", "uchar": "u1"}
    kinds = [(name, forms[form]) for _, form, name in map(str.split, lines[4:])]
    read = np.frombuffer(body, kinds)
    np.testing.assert_array_equal(np.stack([read[a] for a in "xyz"], -1), POINTS.astype("<f4"))
    for name in ("sigma_mm", "quality"):
        np.testing.assert_array_equal(read[name], SURFACE.sigma_z_mm[THERE].astype("<f4"))
    np.testing.assert_array_equal(read["status"], STATUS)
    assert SURFACE.brightness is not None
    np.testing.assert_array_equal(read["intensity"], SURFACE.brightness[THERE].astype("<f4"))
    save_points(tmp_path / "plain.ply", replace(SURFACE, brightness=None))
    assert b"intensity" not in (tmp_path / "plain.ply").read_bytes()


def castagnoli(content: bytes) -> int:
    """CRC-32C, bit by bit (RFC 3720, 12.1)."""
    rest = 2**32 - 1
    for byte in content:
        rest ^= byte
        for _ in range(8):
            rest = rest >> 1 ^ (0x82F63B78 if rest & 1 else 0)
    return rest ^ 2**32 - 1


assert castagnoli(b"123456789") == 0xE3069283  # the check value of CRC-32/ISCSI

E57 = "{http://www.astm.org/COMMIT/E57/2010-e57-v1.0}"
OWN = "{urn:lscan:e57}"


def e57_read(path: Path) -> tuple[dict[str, Floats], ElementTree.Element]:
    """Fields of the only scan's points, and what the XML says of it, after ASTM E2807 alone."""
    content = path.read_bytes()
    magic, major, minor, size, xml_at, xml_length, page = struct.unpack_from("<8sIIQQQQ", content)
    assert (magic, major, minor, size, page) == (b"ASTM-E57", 1, 0, len(content), 1024)
    pages = [content[at : at + page] for at in range(0, size, page)]
    for one in (pages[0], pages[1], pages[-1]):
        assert castagnoli(one[:-4]) == int.from_bytes(one[-4:], "big")
    logical = b"".join(one[:-4] for one in pages)

    def place(physical: int) -> int:
        return physical - 4 * (physical // page)

    root = ElementTree.fromstring(logical[place(xml_at) : place(xml_at) + xml_length])
    assert root.tag == f"{E57}e57Root"
    (scan,) = root.findall(f"{E57}data3D/{E57}vectorChild")
    points = scan.find(f"{E57}points")
    assert points is not None
    section = place(int(points.attrib["fileOffset"]))
    kind, length, at, _ = struct.unpack_from("<B7xQQQ", logical, section)
    assert kind == 1
    fields = list(points.find(f"{E57}prototype") or ())
    kinds = {("Float", None): "<f8", ("Float", "single"): "<f4", ("Integer", None): "u1"}
    forms = [kinds[one.attrib["type"], one.get("precision")] for one in fields]
    streams, at = [b""] * len(fields), place(at)
    while at < section + length:
        kind, flags, size, count = struct.unpack_from("<BBHH", logical, at)
        assert (kind, flags, count) == (1, 0, len(fields)) and (size + 1) % 4 == 0
        lengths = struct.unpack_from(f"<{count}H", logical, at + 6)
        begin = at + 6 + 2 * count
        for number, one in enumerate(lengths):
            streams[number] += logical[begin : begin + one]
            begin += one
        at += size + 1
    read = {
        one.tag.replace(E57, "").replace(OWN, ""): np.frombuffer(stream, form).astype(float)
        for one, stream, form in zip(fields, streams, forms, strict=True)
    }
    assert {len(values) for values in read.values()} == {int(points.attrib["recordCount"])}
    return read, scan


def test_e57_holds_metres_in_double_precision(tmp_path: Path) -> None:
    many = replace(  # more than a packet of 64 KiB holds
        SURFACE, **{name: np.tile(getattr(SURFACE, name), (4, 1)) for name in
        ("sigma_x_mm", "sigma_z_mm", "status", "brightness")},
        xyz_mm=np.tile(SURFACE.xyz_mm, (4, 1, 1)), position_mm=np.arange(80.0),
    )  # fmt: skip
    save_points(tmp_path / "cloud.e57", many)
    read, scan = e57_read(tmp_path / "cloud.e57")
    there = has_value(many.status)
    for place, axis in enumerate("XYZ"):
        values = many.xyz_mm[there][:, place] / 1000
        np.testing.assert_array_equal(read[f"cartesian{axis}"], values)
        for end, extreme in (("Minimum", values.min()), ("Maximum", values.max())):
            bound = scan.findtext(f"{E57}cartesianBounds/{E57}{axis.lower()}{end}")
            assert float(bound or "") == extreme
    for name, sigma in (("sigmaX", many.sigma_x_mm), ("sigmaZ", many.sigma_z_mm)):
        np.testing.assert_allclose(read[name], sigma[there] / 1000, rtol=1e-7)
    np.testing.assert_array_equal(read["status"], many.status[there])
    assert many.brightness is not None
    np.testing.assert_allclose(read["intensity"], np.nan_to_num(many.brightness[there]), rtol=1e-7)
    assert float(scan.findtext(f"{E57}intensityLimits/{E57}intensityMaximum") or "") == 70_000
    assert scan.findtext(f"{E57}name") == "head frame"
    before = (tmp_path / "cloud.e57").read_bytes()
    save_points(tmp_path / "cloud.e57", many)
    assert (tmp_path / "cloud.e57").read_bytes() == before


def test_e57_has_what_a_workpiece_surface_knows(tmp_path: Path) -> None:
    sigma_y = 2 * SURFACE.sigma_z_mm
    aligned = replace(SURFACE, frame="workpiece", sigma_y_mm=sigma_y, brightness=None)
    save_points(tmp_path / "cloud.e57", aligned)
    read, scan = e57_read(tmp_path / "cloud.e57")
    np.testing.assert_allclose(read["sigmaY"], sigma_y[THERE] / 1000, rtol=1e-7)
    assert "intensity" not in read and scan.find(f"{E57}intensityLimits") is None
    assert scan.findtext(f"{E57}name") == "workpiece frame"


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = replace(SURFACE, status=np.full_like(SURFACE.status, int(Status.NO_PEAK)))
    with pytest.raises(InputError, match="no point has a value"):
        save_points(tmp_path / "cloud.las", nothing)
    with pytest.raises(InputError, match=r"no such kind of cloud.*\.ply, \.e57, \.las, \.laz"):
        save_points(tmp_path / "cloud.xyz", SURFACE)
    for name in ("laspy", "lazrs"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            save_points(tmp_path / "cloud.ply", SURFACE)
            with pytest.raises(InputError, match=rf"package {name}: pip install 'lscan\[clouds\]'"):
                save_points(tmp_path / "cloud.laz", SURFACE)
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]


def test_the_command_refuses_a_kind_before_it_reads_a_picture(tmp_path: Path) -> None:
    options = ["-c", "no.json", "-o", str(tmp_path / "s.nc"), "--points", str(tmp_path / "p.xyz")]
    refused = CliRunner().invoke(app, ["reconstruct", "no-run", *options])
    assert isinstance(refused.exception, InputError)
    assert "no such kind of cloud" in str(refused.exception)
