"""Light that surfaces reflect onto each other: closed forms, quadrature, bounds, the judge."""

from math import pi, radians

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from gathered_cases import WATER, spread
from integrator_cases import DRY, make_sheet, one_lobe

from lscan.records import Floats
from sim.meshes import MeshPart, scene_parts
from sim.meshes.parts import move_part, plain_mesh
from sim.render.ambient import reflectance
from sim.render.gathered.line import (
    OFF,
    RAYS,
    SEGMENTS,
    Glow,
    LitLine,
    _line_segments,
    facing,
    lit_line,
    received,
    visible_part,
)
from sim.render.gathered.surfaces import Reflections, lasting, visible_share
from sim.render.layers import W_PER_M2_IN_MW_PER_MM2
from sim.render.materials import mitsuba_shape
from sim.render.plugins.arrays import vectors
from sim.render.sampled.integrator import SheetIntegrator
from sim.render.tank import Tank
from sim.scene import Laser, Pose, head_pose, load_scene
from sim.scene.poses import rotation

HERE = Pose(np.eye(3), np.zeros(3))
ELSEWHERE = Pose(rotation("ZYX", [30.0, -50.0, 110.0]), np.array([20.0, -300.0, 80.0]))
LASER = Laser(power_mw=10.0, apex_mm=[0.0, 0.0, 300.0], fan_half_angle_deg=15.0)
# Places of the wall x = 100, (y, z): beside the line, 1 mm above the floor, and far off.
Y_MM, Z_MM = (v.ravel() for v in np.meshgrid([0.5, -3.0, 20.0, -90.0], [1.0, 5.0, 30.0, 100.0]))
X_MM, Y_FLOOR_MM = (v.ravel() for v in np.meshgrid([92.0, 96.0, 99.0], [1.0, 3.0, 8.0]))
BLACK = 0.0
# Clusters farther than 8 half lengths count as points; the line ends so far from the wall.  By the
# midpoint rule 1/64 of light that falls with the distance's cube is left out.
AS_POINTS = 1 / 60


def block(low: list[float], high: list[float], albedo: float = 0.5) -> MeshPart:
    """A cuboid."""
    mesh = trimesh.creation.box(bounds=[low, high])
    return MeshPart("block", plain_mesh(mesh.vertices, mesh.faces), albedo)


def floor(albedo: float = 0.5) -> MeshPart:
    """200 by 300 mm, its upper side in the plane z = 0."""
    return block([-100, -150, -10], [100, 150, 0], albedo)


def wall(albedo: float = BLACK) -> MeshPart:
    """120 mm high at x = 100, across the line on the floor, which ends 20 mm before it."""
    return block([100, -150, 0], [110, 150, 120], albedo)


class Corner:
    """Parts and a sheet, all moved by a pose."""

    def __init__(
        self, *parts: MeshPart, pose: Pose = HERE, laser: Laser = LASER, water: object = DRY
    ) -> None:
        parts = tuple(move_part(part, pose) for part in parts)
        shapes = {f"{k}": mitsuba_shape(part, 1.33) for k, part in enumerate(parts)}
        self.scene, self.pose = mi.load_dict({"type": "scene", **shapes}), pose
        integrator = SheetIntegrator(mi.Properties())
        integrator.configure(water, [make_sheet(laser, pose)], 0.0)
        self.reflections = Reflections(self.scene, parts, integrator, water)
        self.lit = self.reflections.lit()

    def irradiance(self, start: list[float], places: Floats) -> Floats:
        """Of the (N, 3) places as they are seen from a start, before the corner was moved."""
        eye, ends = self.pose.apply(np.array([start]))[0], self.pose.apply(places)
        way = ends - eye
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        ray = mi.Ray3f(mi.Point3f(*eye.tolist()), vectors(way.T))
        si = self.scene.ray_intersect(ray)
        np.testing.assert_allclose(np.array(si.p).T, ends, atol=1e-3)
        return np.array(self.reflections.irradiance(self.lit, si)[0], dtype=float)

    def of_wall(self) -> Floats:
        """At (Y_MM, Z_MM)."""
        places = np.column_stack([np.full_like(Y_MM, 100.0), Y_MM, Z_MM])
        return self.irradiance([-80.0, 3.0, 60.0], places)


def by_quadrature(albedo: float = 0.5) -> Floats:
    """Irradiance of the wall by the line on the floor, by 20,000 points of the fan."""
    half = radians(LASER.fan_half_angle_deg)
    step = 2 * half / 20_000
    x = 300 * np.tan(step * (np.arange(20_000) + 0.5) - half)
    power = albedo * LASER.power_mw / (2 * half) * step
    off = [100 - x, Y_MM[:, np.newaxis], Z_MM[:, np.newaxis]]
    square = off[0] ** 2 + off[1] ** 2 + off[2] ** 2
    return np.asarray((power / pi * off[0] * off[2] / square**2).sum(axis=1))


def long_line() -> LitLine:
    """1 mW/mm that a floor sends from 20 m of the x axis."""
    x = (np.arange(RAYS) + 0.5) * 20_000 / RAYS - 10_000
    point = np.column_stack([x, np.zeros((RAYS, 2))])
    power = np.full(RAYS, 20_000 / RAYS)
    return _line_segments(power, point, np.tile([0.0, 0.0, 1.0], (RAYS, 1)), np.zeros(RAYS))


def from_line(line: LitLine, y_mm: Floats, z_mm: Floats, normal: list[float]) -> Floats:
    """Irradiance at (0, y, z) by a line."""
    point = mi.Point3f(vectors([0 * y_mm, y_mm, z_mm]))
    upright = mi.Vector3f(*(mi.Float(v) + dr.zeros(mi.Float, len(y_mm)) for v in normal))
    close, far = received(line, point, upright, mi.Float(0), mi.Bool(True))
    return np.array(close + far, dtype=float)


def test_an_endless_line_lights_planes_by_their_view_factors() -> None:
    """Integrals over x of cos cos / (pi r4): z2 / 2 d3 on the plane z above, y z / 2 d3 on a wall
    at y, d = sqrt(y2 + z2); the line's ends, 10 m away, have 1e-6 of it."""
    y = np.array([0.02, 0.1, 3.0, 10.0, 40.0])
    z = np.array([0.5, 0.02, 30.0, 1.0, 40.0])
    distance3 = np.hypot(y, z) ** 3
    line = long_line()
    above = from_line(line, y, z, [0, 0, -1])
    np.testing.assert_allclose(above, z**2 / (2 * distance3), rtol=1e-3)
    beside = from_line(line, y, z, [0, -1, 0])
    np.testing.assert_allclose(beside, y * z / (2 * distance3), rtol=1e-3)


def test_segments_hold_the_power_of_the_fan_whatever_surfaces_it_meets() -> None:
    """10 mW times the albedo."""
    step = block([-20, -50, 0], [30, 50, 40])
    segments = np.array(Corner(floor(), step).lit.lines[0].segments).reshape(SEGMENTS, 12)
    assert segments[:, 7].sum() == pytest.approx(5.0, rel=1e-5)
    assert set(np.round(segments[:, 2], 3)) == {0.0, 40.0}


@pytest.mark.parametrize("pose", [HERE, ELSEWHERE], ids=["here", "elsewhere"])
def test_the_wall_of_a_corner_is_lit_as_by_quadrature(pose: Pose) -> None:
    """Wherever the corner and its laser stand."""
    found = Corner(floor(), wall(), pose=pose).of_wall()
    np.testing.assert_allclose(found, by_quadrature(), rtol=AS_POINTS)


def test_light_is_proportional_to_power_and_to_what_sends_it() -> None:
    """The black wall sends nothing back: what it receives goes with the floor's albedo alone."""
    once = Corner(floor(), wall()).of_wall()
    strong = LASER.model_copy(update={"power_mw": 20.0})
    np.testing.assert_allclose(Corner(floor(), wall(), laser=strong).of_wall(), 2 * once, rtol=1e-5)
    np.testing.assert_allclose(Corner(floor(0.25), wall()).of_wall(), once / 2, rtol=1e-5)


def brightest() -> float:
    """What the sheet gives a surface that faces it at z = 0, mW/mm2: of a Gaussian profile."""
    sheet = make_sheet(LASER)
    sigma, density = 0.5 * sheet.half_width(mi.Float(300)), sheet.power_density(mi.Float(0))
    return float((density / (300 * np.sqrt(2 * pi) * sigma))[0])


def test_a_plane_does_not_light_itself() -> None:
    """But for what rounding leaves, 1e-6 of the sheet's own light; what a white wall sends back is
    more than 3e-4 of it at its foot."""
    places = np.array([[90.0, 0.3, 0.0], [70.0, 2.0, 0.0], [0.0, 0.0, 0.0], [-50.0, -40.0, 0.0]])
    dark, bright = Corner(floor(), wall()), Corner(floor(), wall(0.8))
    assert np.all(dark.irradiance([-80.0, 3.0, 60.0], places) < 1e-6 * brightest())
    back = bright.irradiance([-80.0, 3.0, 60.0], places)
    assert back[0] > 3e-4 * brightest() > back[3] > 0


@pytest.mark.slow
def test_light_in_a_hollow_sphere_is_reflected_on_and_on() -> None:
    """All of its inside sees all of it evenly: of the albedo a, with a hole that is the share f of
    it, even light becomes a (1 - f) / (1 - a (1 - f)) times as much again, to 2 %: what hits the
    rim between two patches counts as lit less, and of 512 directions 0.5 % more or less leave."""
    albedo, angle = 0.6, np.linspace(pi / 6, pi, 40)
    inner, outer = (r * np.column_stack([np.sin(angle), np.cos(angle)]) for r in (50.0, 52.0))
    inner[-1, 0] = outer[-1, 0] = 0.0
    profile = np.concatenate([inner, outer[::-1], inner[:1]])
    shell = trimesh.creation.revolve(profile, sections=64)
    shell.fix_normals()
    bounces = Corner(MeshPart("shell", plain_mesh(shell.vertices, shell.faces), albedo))
    found = bounces.reflections._bounces
    assert found is not None
    more = found.of(np.ones(dr.width(found.sender_point), np.float32))
    point, normal = np.array(found.point), np.array(found.normal)
    inside = (np.sum(point * normal, axis=0) < 0) & (point[2] < 40)
    kept = albedo * (1 + np.cos(pi / 6)) / 2
    assert inside.sum() > 100
    np.testing.assert_allclose(more[inside], kept / (1 - kept), rtol=0.05)
    assert more[inside].mean() == pytest.approx(kept / (1 - kept), rel=0.02)


def test_a_screen_hides_the_line() -> None:
    """A black one 60 mm high before the wall: its foot receives nothing, its top what it did."""
    screen = block([89, -150, 0], [90, 150, 60], BLACK)
    places = np.array([[100.0, 0.0, 10.0], [100.0, 10.0, 30.0], [100.0, 5.0, 119.0]])
    eye = [95.0, 0.0, 110.0]
    open_wall = Corner(floor(), wall()).irradiance(eye, places)
    behind = Corner(floor(), wall(), screen).irradiance(eye, places)
    assert np.all(behind[:2] == 0) and np.all(open_wall > 0)
    # From x < 0 alone the ray to z = 119 passes over the screen: at 90 it is above 60 there.
    assert 0 < behind[2] < open_wall[2]


def test_a_line_on_facets_lights_a_hollow_sphere_evenly() -> None:
    """On the line itself too: what is sent from anywhere in a sphere of the radius r is received
    everywhere as 1 / (4 pi r2) of it (the law of the integrating sphere).  Of light that is taken
    for d off its line 1 - t4 / (t2 + d2)2 is missing t away: 3/2 pi d over all of it.  Facets may
    lose what comes from less than their own length away; nothing makes them brighter."""
    radius, half_angle = 50.0, 40.0
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    part = MeshPart("ball", plain_mesh(ball.vertices, ball.faces), 0.5, smooth=True)
    scene = mi.load_dict({"type": "scene", "ball": mitsuba_shape(part, 1.33)})
    laser = Laser(power_mw=10.0, apex_mm=[0.0, 0.0, 0.0], fan_half_angle_deg=half_angle)
    line = lit_line(scene, make_sheet(laser), dr.ones_like)
    phi, aside = np.meshgrid(np.radians(np.linspace(-35, 35, 401)), [0.0, 0.003, 0.1, 1.0])
    along = np.array([np.sin(phi), aside / radius, -np.cos(phi)], np.float32).reshape(3, -1)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0), dr.normalize(mi.Vector3f(along))))
    close, far = received(line, si.p, facing(si), mi.Float(0), mi.Bool(True))
    even = laser.power_mw * part.albedo / (4 * pi * radius**2)
    share = np.array(close + far)[np.array(si.is_valid())] / even
    near = 1.5 * pi * OFF * laser.waist_mm + 2 * ball.edges_unique_length.max()
    missing = near / (2 * radians(half_angle) * radius)
    assert np.all((1 - missing - AS_POINTS < share) & (share < 1 + AS_POINTS))


def from_wall_to_floor(albedo: float) -> Floats:
    """Irradiance of the places (X_MM, Y_FLOOR_MM) of a floor by what a wall at x = 100 sends of the
    light of the line on the floor, in the corner of an endless one of 1 mW/mm that runs into it.

    The line gives the wall y, z the irradiance z / 2 pi (y2 + z2); sinh steps of y about the line.
    """
    y, z = np.meshgrid(np.sinh(np.linspace(-7, 7, 1401)), np.geomspace(1e-3, 600, 1200))
    area = np.hypot(y, 1) * 0.01 * z * np.log(6e5) / 1199
    sent = albedo / pi * z / (2 * pi * (y**2 + z**2)) * area
    away, beside = 100 - X_MM, Y_FLOOR_MM
    parts = [
        (sent * d * z / (d**2 + z**2 + (y - s) ** 2) ** 2).sum()
        for d, s in zip(away, beside, strict=True)
    ]
    return np.array(parts)


def test_the_corner_that_a_line_runs_into_is_lit_by_the_wall() -> None:
    """Light reflected twice, 1 to 8 mm from line and wall, where patches lie 5 to 20 mm apart.

    A dark wall sends a twentieth: the line on it and a third reflection are known to be that much
    weaker than the floor's.  Each place has 32 directions' 18 %, and what linear interpolation adds
    between nodes to light that goes as the inverse distance, up to 12 %: 20 % of the mean of nine.
    """
    laser = LASER.model_copy(update={"fan_half_angle_deg": 20.0})
    places = np.column_stack([X_MM, Y_FLOOR_MM, 0 * X_MM])
    eye = [-80.0, 3.0, 60.0]
    dark, black = (
        Corner(floor(), wall(albedo), laser=laser).irradiance(eye, places)
        for albedo in (0.05, BLACK)
    )
    assert np.all(black == 0)
    start, end = np.arctan(1 / 3), radians(20.0)
    angle = np.linspace(start, end, 4001)
    angle = (angle[1:] + angle[:-1]) / 2
    density = LASER.power_mw / (2 * end)
    off, z = (100 - X_MM)[:, np.newaxis], 300 - 100 / np.tan(angle)
    square = off**2 + z**2 + Y_FLOOR_MM[:, np.newaxis] ** 2
    line = 0.05 * density * (end - start) / 4000
    once = (line / pi * off * z / square**2).sum(axis=1)
    twice = 0.5 * density * np.cos(start) ** 2 / 300 * from_wall_to_floor(0.05)
    assert (dark - once).mean() == pytest.approx(twice.mean(), rel=0.2)


def test_a_convex_body_hides_nothing_of_its_own_line() -> None:
    """A ball, lit from above: wherever light of its line falls, the way there is free, though the
    line's chords run through the ball.  Facets hide places less than 0.1 rad above the horizon,
    whose light is a fifth of the mean of ten or more that are lit: 0.02."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=70.0)
    part = MeshPart("ball", plain_mesh(ball.vertices, ball.faces), 0.5, smooth=True)
    scene = mi.load_dict({"type": "scene", "ball": mitsuba_shape(part, 1.33)})
    line = lit_line(scene, make_sheet(LASER, HERE), dr.ones_like)
    angle = np.linspace(0, 2 * pi, 40, endpoint=False)
    place = np.array([250 * np.cos(angle), 250 * np.sin(angle), 100 + 0 * angle], np.float32)
    point, normal = mi.Point3f(place), mi.Vector3f(dr.normalize(-mi.Vector3f(place)))
    seen = np.array(visible_part(scene, line, point, normal))
    np.testing.assert_allclose(seen, 1.0, atol=0.02)


def test_patches_light_each_other() -> None:
    """One mW/mm2 on patches of the floor alone: half of what the foot of the wall sees is the
    floor, of the albedo 0.5, less 5 % of that at 10 mm for the floor's end at 200 mm."""
    bounces = Corner(floor(), wall()).reflections._bounces
    assert bounces is not None
    (_, _, sent_from), upright = np.array(bounces.sender_point), np.array(bounces.sender_normal)
    more = bounces.of(np.float32((np.abs(sent_from) < 0.1) & (upright[2] > 0.9)))
    (x, y, z), normal = np.array(bounces.point), np.array(bounces.normal)
    foot = (np.abs(x - 100) < 0.1) & (normal[0] < -0.9) & (z > 0) & (z < 10) & (np.abs(y) < 50)
    assert foot.sum() > 3
    np.testing.assert_allclose(more[foot], 0.25, atol=0.03)


def test_a_strip_finer_than_patches_lights_the_wall_in_proportion() -> None:
    """A Gaussian of 8 mm about x = 64, along the wall at x = 100, where patches lie up to 54 mm
    apart and senders 7.  Of an endless strip at the distance d a place z above the floor receives
    a d z dd / 2 (d2 + z2)^1.5 with the albedo a; the floor's ends at 150 mm, of places within 40 mm
    of its middle, take less than 5 %.  A sum at steps of 7 mm is exact to 1e-6; cells that are not
    square, and 512 directions, leave what 10 % cover."""
    bounces = Corner(floor(), wall()).reflections._bounces
    assert bounces is not None
    (x, _, z), normal = np.array(bounces.sender_point), np.array(bounces.sender_normal)
    strip = np.exp(-(((x - 64) / 8) ** 2) / 2) * ((np.abs(z) < 0.1) & (normal[2] > 0.9))
    more = bounces.of(np.float32(strip))
    (x, y, z), normal = np.array(bounces.point), np.array(bounces.normal)
    on_wall = (np.abs(x - 100) < 0.1) & (normal[0] < -0.9) & (z > 5) & (z < 100) & (np.abs(y) < 40)
    assert on_wall.sum() > 10
    away, step = np.linspace(1, 99, 981, retstep=True)
    height = z[on_wall, np.newaxis]
    seen = 0.25 * away * height / np.hypot(away, height) ** 3 * step
    expected = (seen * np.exp(-(((away - 36) / 8) ** 2) / 2)).sum(axis=1)
    assert more[on_wall].mean() == pytest.approx(expected.mean(), rel=0.1)


def test_what_is_scattered_onto_the_floor_lights_the_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through patches, off the line: half of what the wall's foot sees is the floor, of the albedo
    0.5.  So a quarter of what falls on the floor gets there, a mean between its least and its most,
    .03 of it off, as above."""
    corner = Corner(floor(), wall(), water=WATER)
    integrator, bounces = corner.reflections._integrator, corner.reflections._bounces
    assert bounces is not None
    glow = Glow(integrator.sheets[0], spread(), WATER.extinction_per_mm)
    (_, _, z), normal = np.array(bounces.point), np.array(bounces.normal)
    fallen = np.array(glow.off_strip(bounces.point, bounces.normal))
    fallen = fallen[(np.abs(z) < 0.1) & (normal[2] > 0.9)]
    y = np.linspace(-50.0, 50.0, 11)
    places = np.column_stack([0 * y + 100, y, 0 * y + 5])
    corner.reflections = Reflections(corner.scene, (floor(), wall()), integrator, WATER, [glow])
    corner.lit = corner.reflections.lit()
    light = corner.irradiance([-80.0, 3.0, 60.0], places)
    monkeypatch.setattr(Glow, "off_strip", lambda *_: mi.Float(0))
    corner.lit = corner.reflections.lit()
    light -= corner.irradiance([-80.0, 3.0, 60.0], places)
    assert np.all((0.22 * fallen.min() < light) & (light < 0.28 * fallen.max()))


def test_scattered_light_is_cut_off_where_a_shadow_begins() -> None:
    """A wall at x = 40, 60 mm high, shades the floor to x = 50; patches lie 20 mm apart there.

    Within a patch shares grow by about .2, from the wall to the shadow's edge and beyond it, too:
    the mean of nine places on either side is known to half of that.
    """
    parts = floor(1e-3), block([30, -150, 0], [40, 150, 60], 1e-3)  # nothing else lights them
    corner = Corner(*parts, water=WATER)
    x, y = (v.ravel() for v in np.meshgrid([44.0, 46.0, 48.0, 52.0, 54.0, 56.0], [3.0, -8.0, 20.0]))
    down = mi.Ray3f(mi.Point3f(vectors([x, y, 0 * x + 50])), mi.Vector3f(0, 0, -1))
    si = corner.scene.ray_intersect(down)
    integrator = corner.reflections._integrator
    sheet, normal = integrator.sheets[0], facing(si)
    glow = Glow(sheet, spread(), WATER.extinction_per_mm)
    reflections = Reflections(corner.scene, parts, integrator, WATER, [glow])
    light, (share,) = reflections.irradiance(reflections.lit(), si)
    whole = np.array(glow.irradiance(si.p, normal))
    found = np.array(light + share * glow.irradiance(si.p, normal))
    own = whole * np.array(visible_share(corner.scene, sheet, integrator.phase, si.p, normal))
    for side in (x < 50, x > 50):
        assert found[side].mean() == pytest.approx(own[side].mean(), abs=0.1 * whole[side].mean())
    assert not np.array(share)[x < 50].any(), "light in shadow is not peaked about the sheet"
    assert (own / whole)[x > 50].mean() > (own / whole)[x < 50].mean() + 0.5


def test_water_in_shadow_scatters_nothing() -> None:
    """A plate 100 mm above the floor stops the whole fan: beneath it nothing is lit, though nothing
    lies between the floor and the water above it."""
    corner = Corner(floor(), block([-60, -150, 100], [60, 150, 110]), water=WATER)
    x, y = (v.ravel() for v in np.meshgrid([-30.0, 0.0, 20.0], [0.0, 0.5, -8.0, 60.0]))
    down = mi.Ray3f(mi.Point3f(vectors([x, y, 0 * x + 50])), mi.Vector3f(0, 0, -1))
    si = corner.scene.ray_intersect(down)
    integrator = corner.reflections._integrator
    share = visible_share(corner.scene, integrator.sheets[0], integrator.phase, si.p, facing(si))
    assert not np.array(share).any()


def test_light_that_turns_by_little_is_not_lost() -> None:
    """Of a Henyey-Greenstein lobe the share 1 - g counts, but on the way to the line, beside which
    light lands that turns by little."""
    water = one_lobe(2e-4, 1e-3, 0.9)
    assert lasting(water).extinction_per_mm == pytest.approx(3e-4, rel=1e-3)
    clear, turbid = (Corner(floor(), wall(), water=w).of_wall() for w in (DRY, water))
    # 300 mm at least to the floor and 20 from there, 311 and 250 at most.
    assert np.all(turbid < clear * np.exp(-1.2e-3 * 300 - 3e-4 * 20))
    assert np.all(turbid > clear * np.exp(-1.2e-3 * 311 - 3e-4 * 250))


def test_black_bodies_are_dark() -> None:
    """A tank of nothing else is rendered: black surfaces send nothing on."""
    corner = Corner(floor(BLACK), wall(BLACK), water=WATER)
    assert not corner.of_wall().any()


def test_convex_bodies_are_dark() -> None:
    corner = Corner(floor())
    assert corner.lit.field is None
    assert np.all(corner.irradiance([0.0, 0.0, 50.0], np.array([[10.0, 0.0, 0.0]])) == 0)


def straight_light(tank: Tank, position_mm: float) -> Floats:
    """(H, W) radiance of reflected light that comes straight from surfaces, W/(m2 sr)."""
    assert tank._sparse is not None
    tank._sparse.look(tank.scene.tank.head)
    tank.place(position_mm)
    rays, head = tank._sparse.rays, head_pose(tank.scene.tank.head, position_mm)
    reflections = Reflections(
        tank.mitsuba_scene, scene_parts(tank.scene), tank.integrator, tank.water
    )
    si = tank.mitsuba_scene.ray_intersect(rays.seen_from(head))
    light, _ = reflections.irradiance(reflections.lit(), si)
    loss = dr.exp(-tank.integrator.extinction * si.t) * rays.weight / pi
    sent = dr.select(si.is_valid(), light * reflectance(si) * loss, 0.0)
    picture = np.array(sent, dtype=float).reshape(rays.size_px[::-1])
    return W_PER_M2_IN_MW_PER_MM2 * picture[1:-1, 1:-1]


# Of judge(tank, 63.0, (160, 0, 32, 480), JudgeEffort(1 << 20, 16, 6), seed=3), W/(m2 sr): the
# interreflection in bands of 16 rows from the 20th on, its standard errors, the sum of all 30.
JUDGED = np.array([2.44, 5.08, 9.30, 19.29, 35.69, 46.51, 45.36, 26.56, 13.94, 5.67, 2.44]) * 1e-6
ERRORS = np.array([0.21, 0.24, 0.35, 0.50, 1.06, 2.22, 1.07, 0.55, 0.63, 0.33, 0.17]) * 1e-6
SUM = 2.142e-4


def test_the_sandwave_is_lit_as_the_judge_finds() -> None:
    """In water that scatters nothing, in bands that hold 5 % of the brightest one's light: 8 % and
    three standard errors in each (of 32 clusters of the line each is seen or is not), 5 % of the
    sum."""
    scene = load_scene("paper/sandwave").with_tank(water={"particle_scattering_per_m": 0.0})
    found = straight_light(Tank(scene), 63.0)
    ours = found[:, 160:192].mean(axis=1).reshape(-1, 16).mean(axis=1)
    assert np.all(np.abs(ours[19:30] - JUDGED) < 0.08 * JUDGED + 3 * ERRORS)
    assert ours.sum() == pytest.approx(SUM, rel=0.05)
