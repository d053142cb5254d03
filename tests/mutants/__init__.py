"""Mutants: mistakes put into lscan and sim, one at a time, each of which a quick test must notice.

As a plug-in of pytest, this stops at the first example that fails: a smaller one is not looked for.
"""

from hypothesis import Phase, settings


def pytest_configure() -> None:
    usual = settings.get_current_profile_name()
    settings.register_profile(
        "mutants", settings.get_profile(usual), phases=(Phase.explicit, Phase.generate)
    )
    settings.load_profile("mutants")
