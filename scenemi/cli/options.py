"""Options that commands of `scenemi` share."""

from __future__ import annotations

from typing import Annotated

import typer

Weights = Annotated[str, typer.Option(help="small, a .safetensors file, or interpolation.", metavar="NAME")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.", metavar="NAME")]
Steps = Annotated[int | None, typer.Option(min=1, help="1 = the expected motion, 20 = a sample, 1000 = the paper's.")]
Temperature = Annotated[
    float | None,
    typer.Option(min=0, max=1, help="1 = motions as varied as the data; less = nearer to the expected one."),
]
Settings = Annotated[
    str | None,
    typer.Option(
        help="Settings: a JSON file, or tiny, gpu, paper ... (docs/scenemi.md). Default: small.", metavar="NAME"
    ),
]
Method = Annotated[
    str | None,
    typer.Option(
        help="A method that the paper compares with, as large as --config: mdm, condmdi ... (docs/scenemi.md).",
        metavar="NAME",
    ),
]
