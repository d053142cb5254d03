"""Where a report's pictures come from and what turned them into numbers, in words.

A run whose camera is the tank's says so; what was played back, or came over a network, may have
been rendered as well, but no run can know.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from lscan.acquisition.run import Run

PARTS = ("board", "groove", "sandwave")
PAPERS_EXTRACTORS = {"centroid", "centroid-relative"}
"""Eq. (8) with the intensities as they are, or above the lowest (Sec. V.B)."""
SIMULATED = "simulated tank"
_TANK_DRIVER = "sim"

Results = Mapping[str, Any]


@dataclass(frozen=True)
class PictureSource:
    """Where a run's pictures come from.

    camera: its driver.  simulated: whether that is known to be the tank's.
    noise: whether the simulated sensor has any.  noise_seed: None where the run states none.
    """

    camera: str
    simulated: bool
    noise: bool = True
    noise_seed: int | None = None

    def as_json(self) -> dict[str, Any]:
        """The entry of results.json: of a camera that is not the tank's its driver alone."""
        return asdict(self) if self.simulated else {"camera": self.camera}


def picture_source(run: Run) -> PictureSource:
    """Where the run's pictures come from, by the rig document that it keeps."""
    driver = run.rig_file.rig.camera.driver
    if driver != _TANK_DRIVER:
        return PictureSource(driver, simulated=False)
    sensor: object = run.rig_file.section("sensor")
    stated = sensor if isinstance(sensor, dict) else {}  # a run folder may come from anybody
    noise = stated.get("noise") is not False
    return PictureSource(driver, True, noise, _whole(stated.get("seed")))


def note(results: Results, parts: Collection[str]) -> str:
    """What a caption says of pictures of these parts; "" where none is known to be simulated.

    Such as "Simulated tank, noise seed 1."; where the others are not: "Groove: simulated tank,
    noise seed 1."  results: results.json.
    """
    there = {part: source for part, source in _sources(results).items() if part in parts}
    simulated = _simulated(there)
    if not simulated:
        return ""
    said = f"{SIMULATED}, {_noise(simulated.values())}."
    if len(simulated) < len(there):
        said = f"{' and '.join(simulated)}: {said}"
    return said[0].upper() + said[1:]


def title(results: Results) -> str:
    """The page's title: the scene's name, and whether the tank was simulated."""
    scene, sources = str(results.get("scene", "unnamed")), _sources(results)
    simulated = _simulated(sources)
    if not simulated:
        return scene
    which = "" if len(simulated) == len(sources) else f": {', '.join(simulated)}"
    return f"{scene} ({SIMULATED}{which})"


def lead(results: Results) -> str:
    """The page's first sentence."""
    sources = _sources(results)
    simulated = _simulated(sources)
    scanner = "Report of an underwater laser line scanner"
    if not simulated:
        return f"{scanner}: what was found, beside what the paper printed."
    which = "" if len(simulated) == len(sources) else f" of {' and '.join(simulated)}"
    return (
        f"{scanner} in a {SIMULATED}: the pictures{which} were rendered, "
        f"{_noise(simulated.values())}. What was found in them stands beside what the paper "
        "printed of a real tank."
    )


def cameras(results: Results) -> str:
    """Which camera driver took which pictures, such as "sim (board, groove)"; "" if unknown."""
    by_driver: dict[str, list[str]] = {}
    for part, source in _sources(results).items():
        by_driver.setdefault(str(source.get("camera")), []).append(part)
    return ", ".join(f"{driver} ({', '.join(parts)})" for driver, parts in by_driver.items())


def chain_names(results: Results) -> tuple[str, str]:
    """What the columns of our two chains are called.

    The first is the paper's where the line was found by its rules too; else its map alone is.
    """
    chain = results.get("chain")
    if not chain:
        return "Ours", "Ours, best chain"
    papers = set(chain["extractors"]) <= PAPERS_EXTRACTORS and not chain["corrected_for"]
    return f"Ours, paper’s {'chain' if papers else 'map'}", "Ours, best chain"


def chains_in_words(results: Results) -> str:
    """What the two chains are, in two sentences, or why there is but one; "" if unknown."""
    chain, best = results.get("chain"), results.get("best") or {}
    if not chain:
        return ""
    first, second = (name.removeprefix("Ours, ") for name in chain_names(results))
    paper = f"The {first}: {_chain_in_words(chain)}."
    if best.get("chain"):
        ours = f"The {second}: {_chain_in_words(best['chain'])}."
        return f"Two chains read the same pictures. {paper} {ours}"
    return f"{paper} No {second}: {best['refused']}." if best.get("refused") else paper


def _whole(number: object) -> int | None:
    return number if isinstance(number, int) and not isinstance(number, bool) else None


def _sources(results: Results) -> Mapping[str, Results]:
    return results.get("pictures") or {}


def _simulated(sources: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {part: source for part, source in sources.items() if source.get("simulated")}


def _noise(sources: Collection[Mapping[str, Any]]) -> str:
    """Such as "noise seed 1"."""
    noisy = [source for source in sources if source.get("noise", True)]
    if not noisy:
        return "without noise"
    seeds = {source["noise_seed"] for source in noisy if source.get("noise_seed") is not None}
    if not seeds:
        return "noise seed not stated"
    return f"noise seed{'s' if len(seeds) > 1 else ''} {' and '.join(map(str, sorted(seeds)))}"


def _chain_in_words(chain: Results) -> str:
    said = f"plane map {chain['plane_map']}"
    if chain["extractors"]:
        said += f", line by {' and '.join(chain['extractors'])}"
    if chain["corrected_for"]:
        said += f", corrected for {' and '.join(chain['corrected_for'])}"
    return said
