"""Surfaces as Mitsuba sees them: against closed forms, energy, reciprocity, their own sampling."""

from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import trimesh
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.errors import InputError
from lscan.files.meshes import load_mesh
from lscan.records import Floats
from sim.meshes import Finish, MeshPart, Paint
from sim.meshes.parts import vertex_paint
from sim.render.materials import mi, mitsuba_shape, surface
from sim.render.plugins.arrays import vectors

WATER = 1.3313  # fresh water, 20 C, 650 nm
SAMPLES = 100_000
FINISHES = [
    Finish("matt"),
    Finish("wet", roughness=0.02),
    Finish("wet", roughness=0.1),
    Finish("wet", roughness=0.6, coat_index=1.8),
    Finish("mirror", roughness=0.02),
    Finish("mirror", roughness=0.5),
    Finish("mirror", roughness=1.0),
]
NAMES = [f"{finish.kind}-{finish.roughness}" for finish in FINISHES]
finishes = pytest.mark.parametrize("finish", FINISHES, ids=NAMES)
some = examples(10)


def square(finish: Finish, albedo: float = 0.5, paint: Paint | None = None) -> MeshPart:
    """A level square of 1 by 1 mm with a corner at the origin."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    return MeshPart("square", mesh, albedo, finish=finish, paint=paint)


def directions(generator: np.random.Generator, count: int) -> Floats:
    """(N, 3) unit vectors, uniform over the upper half sphere, those that graze left out."""
    z = generator.uniform(0.02, 1, count)
    turn = generator.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z**2)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def at(angle: float, count: int = SAMPLES) -> Floats:
    """(N, 3) the same direction, ``angle`` off the normal, N times."""
    return np.tile([np.sin(angle), 0.0, np.cos(angle)], (count, 1))


def scattering(part: MeshPart, towards: Floats) -> tuple[mi.BSDF, mi.SurfaceInteraction3f]:
    """The part's scattering function, and interactions seen from ``towards``, (N, 3)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(towards))
    si.wi = vectors(towards.T)
    return mi.load_dict(surface(part, WATER)), si


def evaluate(part: MeshPart, towards: Floats, lit_from: Floats) -> Floats:
    """(N,) f cos, 1/sr, seen from ``towards`` and lit from ``lit_from``, (N, 3)."""
    bsdf, si = scattering(part, towards)
    return np.array(bsdf.eval(mi.BSDFContext(), si, vectors(lit_from.T))).ravel().astype(float)


def sample(part: MeshPart, towards: Floats, seed: int) -> tuple[mi.BSDFSample3f, Floats]:
    """Directions drawn by Mitsuba, and their weights (N,)."""
    bsdf, si = scattering(part, towards)
    numbers = np.random.default_rng(seed).random((3, len(towards)), dtype=np.float32)
    one, two = mi.Float(numbers[0]), mi.Point2f(mi.Float(numbers[1]), mi.Float(numbers[2]))
    bs, weight = bsdf.sample(mi.BSDFContext(), si, one, two)
    return bs, np.array(weight).ravel().astype(float)


def reflectances(part: MeshPart, place: Floats) -> Floats:
    """(N,) albedo of a matt part at places (N, 2), met by rays from above, lit from above."""
    scene = mi.load_dict({"type": "scene", "part": mitsuba_shape(part, WATER)})
    origins = vectors([*place.T, np.ones(len(place))])
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origins), mi.Vector3f(0, 0, -1)))
    assert dr.all(si.is_valid())
    straight = mi.Vector3f(0, 0, 1)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(straight))
    return np.array(value).ravel() * np.pi


def fresnel(cosine: Floats, index: float) -> Floats:
    """Unpolarised reflectance into a medium denser by ``index`` (above or below 1)."""
    inside = 1 - (1 - cosine**2) / index**2
    c = np.sqrt(np.maximum(inside, 0.0))
    s = ((cosine - index * c) / (cosine + index * c)) ** 2
    p = ((index * cosine - c) / (index * cosine + c)) ** 2
    return np.where(inside > 0, (s + p) / 2, 1.0)


def saunderson(cosine: float, albedo: float, index: float) -> float:
    """Reflectance of a matt ground under a smooth coat: Saunderson 1942.

    F + (1 - F) rho (1 - Fi) / (1 - rho Fi), Fi the diffuse reflectance from within, here the
    integral of 2 c F(c) by Gauss's rule on both sides of the critical angle.
    """
    edge = np.sqrt(1 - 1 / index**2)
    nodes, weights = np.polynomial.legendre.leggauss(400)
    c = edge + (1 - edge) * (nodes + 1) / 2
    beyond = float(np.sum(weights * 2 * c * fresnel(c, 1 / index))) * (1 - edge) / 2
    within = edge**2 + beyond
    first = float(fresnel(np.array(cosine), index))
    return first + (1 - first) * albedo * (1 - within) / (1 - albedo * within)


@pytest.mark.parametrize("albedo", [0.0, 0.37, 1.0])
def test_matt_is_lamberts_law(albedo: float) -> None:
    """f cos = albedo cos / pi whatever the directions, to float32."""
    generator = np.random.default_rng(3)
    towards, lit_from = directions(generator, 4000), directions(generator, 4000)
    value = evaluate(square(Finish(), albedo), towards, lit_from)
    np.testing.assert_allclose(value, albedo * lit_from[:, 2] / np.pi, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("angle", "albedo"), [(0.0, 0.9), (0.5, 0.05), (0.5, 0.5), (1.0, 0.0)])
def test_a_smooth_wet_coat_is_saundersons(angle: float, albedo: float) -> None:
    """Four standard errors, and the 1 % that is asked of the tank's radiometry.

    The plugin's quadrature of the light reflected within takes a few tenths of a percent of
    it; leaving that light out ("nonlinear" off) would be wrong by up to 30 %.
    """
    part = square(Finish("wet", roughness=0.02), albedo)
    _, weight = sample(part, at(angle), seed=3)
    expected = saunderson(np.cos(angle), albedo, 1.5 / WATER)
    error = 4 * weight.std() / np.sqrt(SAMPLES)
    assert weight.mean() == pytest.approx(expected, abs=error + 0.01 * expected)


@pytest.mark.parametrize("angle", [0.0, 1.0])
def test_a_mirror_throws_the_light_where_a_mirror_does(angle: float) -> None:
    """Smooth facets hide little, so nearly all the albedo comes back, about the mirrored ray.

    Smith's shadowing loses tan(theta) alpha / 2 at most; a facet tilted by alpha turns the
    ray by 2 alpha, and Beckmann's slopes beyond 4 alpha have the share exp(-16).  The mean
    ray is off at second order only: by 2 alpha^2 for slopes of variance alpha^2, and some
    for the facets seen more than others.
    """
    alpha = 0.02
    bs, weight = sample(square(Finish("mirror", alpha), 0.9), at(angle), seed=4)
    wo = np.array(bs.wo).T.astype(float)
    assert 0.9 * (1 - alpha * np.tan(angle) / 2) - 1e-4 <= weight.mean() <= 0.9 * (1 + 1e-5)
    mirrored = np.array([-np.sin(angle), 0.0, np.cos(angle)])
    assert np.arccos(np.clip(wo @ mirrored, -1, 1)).max() <= 2 * np.arctan(4 * alpha)
    assert np.linalg.norm(wo.mean(axis=0) - mirrored) < 10 * alpha**2 + 1e-3


@finishes
@pytest.mark.parametrize("angle", [0.0, 1.5])
def test_no_finish_reflects_more_than_falls_on_it(finish: Finish, angle: float) -> None:
    """With an albedo of 1, four standard errors and 2e-3 of the coat's tables above 1."""
    _, weight = sample(square(finish, 1.0), at(angle), seed=5)
    assert np.isfinite(weight).all()
    assert weight.min() >= 0
    assert 0.2 < weight.mean() <= 1 + 4 * weight.std() / np.sqrt(SAMPLES) + 2e-3


@finishes
def test_light_may_go_either_way(finish: Finish) -> None:
    """f(a, b) = f(b, a) to float32, whose rounding a smooth facet's slope amplifies.

    Beckmann's exponent tan2/alpha2 may be large, and its rounding error then is a relative
    error of f: pairs with f below 1e-6 are compared by their difference only.
    """
    generator = np.random.default_rng(1)
    one, other = directions(generator, 4000), directions(generator, 4000)
    there = evaluate(square(finish), one, other) / other[:, 2]
    back = evaluate(square(finish), other, one) / one[:, 2]
    np.testing.assert_allclose(there, back, rtol=2e-3, atol=1e-6)


@finishes
def test_what_is_drawn_is_what_is_evaluated(finish: Finish) -> None:
    """weight times density is f cos at every direction drawn, to float32."""
    towards = directions(np.random.default_rng(2), 4000)
    bs, weight = sample(square(finish), towards, 2)
    density = np.array(bs.pdf).astype(float)
    value = evaluate(square(finish), towards, np.array(bs.wo).T)
    drawn = (weight > 0) & (value > 1e-6 * density)
    assert drawn.mean() > 0.5
    np.testing.assert_allclose((weight * density)[drawn], value[drawn], rtol=2e-3)


@pytest.mark.parametrize(
    ("finish", "angle"), [(FINISHES[0], 0.9), (FINISHES[3], 0.9), (FINISHES[5], 0.2)]
)
def test_sampling_and_quadrature_give_one_albedo(finish: Finish, angle: float) -> None:
    """The mean weight against the integral of f cos over the half sphere, midpoint rule."""
    part = square(finish)
    _, weight = sample(part, at(angle), seed=6)
    z, turn = np.meshgrid((np.arange(200) + 0.5) / 200, (np.arange(400) + 0.5) * np.pi / 200)
    r = np.sqrt(1 - z**2)
    grid = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1).reshape(-1, 3)
    value = evaluate(part, at(angle, len(grid)), grid)
    error = 4 * weight.std() / np.sqrt(SAMPLES)
    # The rule's own error: cell^2 / 24 of a second derivative of order 1 / alpha^2 = 4.
    assert weight.mean() == pytest.approx(value.mean() * 2 * np.pi, abs=error + 1e-4)


@pytest.mark.parametrize("finish", [FINISHES[0], FINISHES[3], FINISHES[5]])
def test_both_sides_reflect_alike(finish: Finish) -> None:
    """Meshes of users may be wound either way."""
    generator = np.random.default_rng(7)
    towards, lit_from = directions(generator, 300), directions(generator, 300)
    part = square(finish)
    below = np.array([1.0, 1.0, -1.0])
    np.testing.assert_allclose(
        evaluate(part, towards, lit_from),
        evaluate(part, towards * below, lit_from * below),
        rtol=1e-4,
        atol=1e-7,
    )


@pytest.mark.parametrize("index", [WATER, 1.34])
def test_a_coat_thinner_than_the_water_is_refused(index: float) -> None:
    with pytest.raises(InputError, match=r"target\.coat_index.*denser.*1\.33.*above"):
        mitsuba_shape(square(Finish("wet", coat_index=1.33)), index)


@some
@given(
    rows=st.integers(1, 5), columns=st.integers(1, 5), albedo=st.floats(0.1, 1), seed=st.integers(0)
)
def test_a_picture_lies_upright_and_repeats(
    rows: int, columns: int, albedo: float, seed: int
) -> None:
    """At the middle of every texel, in the first tile and in others, its level times albedo.

    The interpolation's weight there is off by float32's rounding of a place of up to 20
    texels: 20 * 2^-23 = 2.4e-6 of the step between two levels.
    """
    generator = np.random.default_rng(seed)
    levels, tiles = generator.random((rows, columns)), 4
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    part = square(Finish(), albedo, Paint(levels, corners * tiles - 1))
    i, j = generator.integers(0, rows * tiles, 50), generator.integers(0, columns * tiles, 50)
    place = np.column_stack([(j + 0.5) / (columns * tiles), 1 - (i + 0.5) / (rows * tiles)])
    assert reflectances(part, place) == pytest.approx(
        albedo * levels[i % rows, j % columns], abs=1e-5
    )


@some
@given(seed=st.integers(0, 1000), albedo=st.floats(0.1, 1))
def test_vertex_colours_are_linear_over_a_triangle(seed: int, albedo: float) -> None:
    """Barycentric mean of the corners' grey levels, times albedo, to float32."""
    generator = np.random.default_rng(seed)
    bare = square(Finish())
    grey = generator.integers(0, 256, 4).astype(np.uint8)
    bare.mesh.visual.vertex_colors = np.column_stack([grey, grey, grey, np.full(4, 255)])
    part = square(Finish(), albedo, vertex_paint(bare.mesh))
    x, y = np.sort(generator.uniform(0.01, 0.99, (40, 2)), axis=1)[:, ::-1].T  # below x = y
    expected = grey[0] * (1 - x) + grey[1] * (x - y) + grey[2] * y
    got = reflectances(part, np.column_stack([x, y]))
    assert got == pytest.approx(albedo * expected / 255, abs=2e-6)


@pytest.mark.parametrize("kind", ["wet", "mirror"])
def test_paint_goes_with_every_finish(kind: str) -> None:
    """A painted surface of one level is the plain one of that albedo."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    finish = Finish(kind, roughness=0.3)  # type: ignore[arg-type]
    generator = np.random.default_rng(8)
    towards, lit_from = directions(generator, 100), directions(generator, 100)
    painted = evaluate(square(finish, 0.8, Paint(np.full((2, 2), 0.5), corners)), towards, lit_from)
    plain = evaluate(square(finish, 0.4), towards, lit_from)
    np.testing.assert_allclose(painted, plain, rtol=1e-4, atol=1e-7)


def test_colours_out_of_a_file_reach_the_surface(tmp_path: Path) -> None:
    """Two triangles of two colours that share an edge: the colours do not run together."""
    path = tmp_path / "two.ply"
    low, high = "51 51 51", "204 204 204"
    corners = ["0 0 0", "1 0 0", "1 1 0", "0 0 0", "1 1 0", "0 1 0"]
    lines = [f"{c} {low if k < 3 else high}" for k, c in enumerate(corners)]
    header = ["ply", "format ascii 1.0", "element vertex 6"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    header += ["element face 2", "property list uchar int vertex_indices", "end_header"]
    path.write_text("\n".join([*header, *lines, "3 0 1 2", "3 3 4 5"]) + "\n")
    mesh = load_mesh(path)
    part = MeshPart("mesh", mesh, 1.0, paint=vertex_paint(mesh))
    got = reflectances(part, np.array([[0.7, 0.6], [0.6, 0.7]]))
    assert got == pytest.approx([0.2, 0.8], abs=1e-6)


def test_smooth_parts_are_shaded_with_their_normals() -> None:
    """Normals that lean by 30 degrees turn Lambert's cosine with them."""
    part = square(Finish(), 1.0)
    part.mesh.vertex_normals = np.tile([np.sin(np.pi / 6), 0, np.cos(np.pi / 6)], (4, 1))
    smooth = replace(part, smooth=True)
    place = np.array([[0.7, 0.3]])
    assert reflectances(smooth, place) == pytest.approx([np.cos(np.pi / 6)], abs=1e-6)
    assert reflectances(part, place) == pytest.approx([1.0], abs=1e-6)
