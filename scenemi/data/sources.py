"""Which sources may be used for what."""

from __future__ import annotations

from collections.abc import Iterable

NONCOMMERCIAL_SOURCES: frozenset[str] = frozenset({"bandai1", "bandai2", "sie", "amass", "trumans", "gimo", "prox"})
"""Sources whose licence forbids commercial use; they are left out unless asked for."""
UNCONFIRMED_SOURCES: frozenset[str] = frozenset({"mhad"})
"""Sources whose licence could not be read; they are left out unless asked for, and no weights trained on them ship.

Berkeley MHAD is said to be free with citation by others who pass it on; its publisher's own text was not at hand. Good
for evaluation.
"""


def is_free(source: str) -> bool:
    """Whether clips of a source may be used commercially. Sources of the user's own count as free."""
    return source not in NONCOMMERCIAL_SOURCES | UNCONFIRMED_SOURCES


BROKEN_CLIPS: frozenset[str] = frozenset({"cmudaz_13_18", "cmudaz_14_23"})
"""Clips whose elbows bend backward in the source; they are left out everywhere."""

_CMU = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF\n"
    "EIA-0196217; conversions by B. Hahne (cgspeed) and others named in NOTICE."
)
_ATTRIBUTION = {
    "cmu": _CMU,
    "deepmimic": "DeepMimic: MIT, (c) 2018 Xue Bin Peng; arpspoof/Jump: MIT, (c) 2021 arpspoof.",
    "accad": (
        "Open Motion Project by ACCAD/The Ohio State University is licensed under a Creative Commons Attribution 3.0\n"
        "Unported License (https://creativecommons.org/licenses/by/3.0/). Changed: other\n"
        "skeletons, 30 fps, floor shifted."
    ),
    "synthetic": "Synthetic clips were made by `video2anim synth`.",
}
"""What has to be said of sources, by the beginning of their names."""


def attribution_of(sources: Iterable[str]) -> str:
    """What weights trained on these sources have to say of them, a line or more each."""
    found = {name: text for name, text in _ATTRIBUTION.items() if any(s.startswith(name) for s in sources)}
    return "\n".join(found.values()) + "\n"
