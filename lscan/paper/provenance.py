"""Where a report's pictures come from and what turned them into numbers, in words.

A run whose camera is the tank's says so; what was played back, or came over a network, may have
been rendered as well, but no run can know.
"""

from collections.abc import Collection, Mapping

from lscan.acquisition.run import Run, Versions, software_versions
from lscan.paper.experiment import Chain, Experiment, PictureSource

PARTS = ("board", "groove", "sandwave")
PAPERS_EXTRACTORS = {"centroid", "centroid-relative"}
"""Eq. (8) with the intensities as they are, or above the lowest (Sec. V.B)."""
_TANK_DRIVER = "sim"

Sources = Mapping[str, PictureSource]


def chain_versions(experiment: Experiment) -> Versions:
    """Name to version of what made an experiment's figures of its pictures.

    Parameters
    ----------
    experiment : Experiment, its chain and best chain count
    """
    chains = [one.chain for one in (experiment, experiment.best) if one is not None]
    extractors = [("lscan.extractors", name) for chain in chains for name in chain.extractors]
    return software_versions(
        [*extractors, *(("lscan.planemaps", chain.plane_map) for chain in chains)]
    )


def picture_source(run: Run) -> PictureSource:
    """Where the run's pictures come from, by the rig document that it keeps.

    Parameters
    ----------
    run : Run, of any camera
    """
    driver = run.rig_file.rig.camera.driver
    if driver != _TANK_DRIVER:
        return PictureSource(driver, simulated=False)
    sensor: object = run.rig_file.section("sensor")
    stated = sensor if isinstance(sensor, dict) else {}  # a run folder may come from anybody
    seed = stated.get("seed")
    whole = isinstance(seed, int) and not isinstance(seed, bool)
    return PictureSource(driver, True, stated.get("noise") is not False, seed if whole else None)


def note(sources: Sources, parts: Collection[str] = PARTS) -> str:
    """What a caption says of pictures of some parts; "" where none is known to be simulated.

    Such as "Simulated tank, noise seed 1."; where the others are not: "Groove: simulated tank,
    noise seed 1."

    Parameters
    ----------
    sources : mapping of PictureSource, by "board", "groove" and "sandwave"
    parts : collection of str, of these names
    """
    there = {part: source for part, source in sources.items() if part in parts}
    simulated = simulated_parts(there)
    if not simulated:
        return ""
    words = f"simulated tank, {noise_words(simulated.values())}."
    if len(simulated) < len(there):
        words = f"{' and '.join(simulated)}: {words}"
    return words[0].upper() + words[1:]


def chain_names(chain: Chain) -> tuple[str, str]:
    """What the columns of our two chains are called.

    Parameters
    ----------
    chain : Chain, the first.  It is the paper's where the line was found by the paper's rules too;
        else its map alone is.

    Examples
    --------
    >>> chain_names(Chain("graticule-2", extractors=("ml",)))
    ('Ours, paper’s map', 'Ours, best chain')
    """
    papers = set(chain.extractors) <= PAPERS_EXTRACTORS and not chain.corrected_for
    return f"Ours, paper’s {'chain' if papers else 'map'}", "Ours, best chain"


def describe_chains(experiment: Experiment) -> str:
    """What the two chains are, in two sentences, or why there is but one.

    Parameters
    ----------
    experiment : Experiment, its chain and best chain count
    """
    names = chain_names(experiment.chain)
    first, second = (name.removeprefix("Ours, ") for name in names)
    words = f"The {first}: {_describe(experiment.chain)}."
    if experiment.best is not None:
        better = _describe(experiment.best.chain)
        return f"Two chains read the same pictures. {words} The {second}: {better}."
    refused = experiment.best_refused
    return f"{words} No {second}: {refused}." if refused else words


def simulated_parts(sources: Sources) -> Sources:
    """Those of the sources that are known to be simulated."""
    return {part: source for part, source in sources.items() if source.simulated}


def noise_words(sources: Collection[PictureSource]) -> str:
    """Such as "noise seed 1"."""
    noisy = [source for source in sources if source.noise]
    if not noisy:
        return "without noise"
    seeds = {source.noise_seed for source in noisy if source.noise_seed is not None}
    if not seeds:
        return "noise seed not stated"
    return f"noise seed{'s' if len(seeds) > 1 else ''} {' and '.join(map(str, sorted(seeds)))}"


def _describe(chain: Chain) -> str:
    words = f"plane map {chain.plane_map}"
    if chain.extractors:
        words += f", line by {' and '.join(chain.extractors)}"
    if chain.corrected_for:
        words += f", corrected for {' and '.join(chain.corrected_for)}"
    return words
