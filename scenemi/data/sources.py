"""Which motion may be used for what: by the license of each clip, which the archive says or its source's name does."""

from __future__ import annotations

from collections.abc import Iterable

from video2anim.errors import UsageError

UNKNOWN_LICENSE = "unknown"
FREE_LICENSES = ("own", "CC0-1.0", "CC-BY-3.0", "CC-BY-4.0", "MIT", "BSD-3-Clause", "Apache-2.0", "LicenseRef-CMU")
"""Licenses that allow commercial use of clips and of what was learned from them; `own` is motion that the user recorded
or made. All others, unknown ones too, are not known to be free: such clips are left out unless asked for, and no
weights trained on them ship."""
_NONCOMMERCIAL = "LicenseRef-noncommercial"
_LICENSES = {
    **dict.fromkeys(("cmu_asfamc", "cmu_cc60", "cmu_daz", "cmu_expmap38", "cmu_humanoid44"), "LicenseRef-CMU"),
    "deepmimic": "MIT", "accad": "CC-BY-3.0", "synthetic": "own",
    **dict.fromkeys(("bandai1", "bandai2", "sie"), "CC-BY-NC-4.0"),
    **dict.fromkeys(("amass", "trumans", "gimo", "prox"), _NONCOMMERCIAL),
    # Berkeley MHAD is said to be free with citation by others who pass it on; its publisher's own text was not at hand.
    "mhad": UNKNOWN_LICENSE,
}  # fmt: skip
"""Of sources that are known by name."""


def license_of(source: str) -> str:
    """License of a source that is known by name, else `unknown`."""
    return _LICENSES.get(source, UNKNOWN_LICENSE)


def is_free(license_name: str) -> bool:
    """Whether clips under a license may be used commercially."""
    return license_name in FREE_LICENSES


def checked_license(source: str, license_name: str | None) -> str:
    """License of clips that a user says to be of a source.

    Raises:
        UsageError: the source is not known and no license is given, or another one than a known source has.
    """
    known = license_of(source)
    if license_name is None and source not in _LICENSES:
        raise UsageError(
            f"--license: want the license of {source!r}, which is not known by name; free for any use are "
            f"{', '.join(FREE_LICENSES)}"
        )
    if license_name is not None and source in _LICENSES and license_name != known:
        raise UsageError(f"--license: {source} has {known}, got {license_name}; give another --source if it is another")
    return license_name or known


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
