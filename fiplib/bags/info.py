"""A description of the contents of a bag."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fiplib.bags import survey
from fiplib.bags.checks import findings, passed
from fiplib.bags.reader import read
from fiplib.params import Params
from fiplib.recording import BagError, Flight

Remarks = Mapping[str, Callable[[Flight], str]]
"""Further lines of a description, for what this room cannot know: the first word of each, and what says the rest."""


def inform(path: Path, reading: Mapping[str, Any], remarks: Remarks | None = None) -> str:
    """Describe any bag: a flight with its checks, or what there is where no flight can be read.

    ``reading`` are keyword arguments of ``read``. Raises BagError if nothing can be read at all.
    """
    try:
        flight = read(path, **reading)
    except BagError as error:
        try:
            found = survey.survey(path)
        except BagError:
            raise error from None
        why = str(error).removeprefix(f"{path}: ")
        return f"{'bag':<10} {path}\n{'flight':<10} none: {why}\n\n{found}"
    return "\n".join([describe(flight, remarks), "", *survey.stamps(path)])


def describe(flight: Flight, remarks: Remarks | None = None) -> str:
    """Describe a flight: origin, scenario, duration, topics, parameters that differ from the default."""
    origin = {"simulated": "SIMULATED, not a real vehicle", "real": "real", "unknown": "unknown (the bag does not say)"}
    words = {key: flight.metadata.get(key, "-") for key in ("scenario", "version", "seed")}
    lines = [f"{'bag':<10} {flight.path}", f"{'origin':<10} {origin[flight.metadata['origin']]}"]
    lines += [f"{key:<10} {value}" for key, value in words.items()]
    if isinstance(recovered := flight.metadata.get("recovered"), dict):
        lines.append(f"{'recovered':<10} from {recovered.get('from')}, {recovered.get('damaged_bytes')} bytes damaged")
        lines[-1] += "" if recovered.get("finished") else ", without the end of the recording"
    lines += [f"{'duration':<10} {flight.duration:.2f} s", f"{'events':<10} {len(flight.events)}"]
    lines += [f"{'assumed' if not i else '':<10} {note}" for i, note in enumerate(flight.notes)]
    against = findings(flight)
    checked = [*(finding.sentence for finding in against), f"passed: {', '.join(passed(flight, against)) or 'none'}"]
    lines += [*survey.bodies(flight), *(f"{'' if i else 'checks':<10} {said}" for i, said in enumerate(checked))]
    lines += [*(f"{word:<10} {say(flight)}" for word, say in (remarks or {}).items()), ""]
    width = max(len(info.topic) for info in flight.topics)
    kind = max(len(info.type) for info in flight.topics)
    lines.append(f"{'topic':<{width}}  {'type':<{kind}}  {'messages':>8}  {'Hz':>6}  role")
    for info in flight.topics:
        rate = f"{(info.count - 1) / flight.duration:.1f}" if info.count > 1 and flight.duration > 0 else "-"
        lines.append(f"{info.topic:<{width}}  {info.type:<{kind}}  {info.count:>8}  {rate:>6}  {info.role}".rstrip())
    lines += ["", "parameters that differ from the default"]
    params, default = flight.params.to_dict(complete=True), Params().to_dict(complete=True)
    changed = [
        f"  {group}.{name} = {value} {field.metadata['unit']} (default {default[group][name]})"
        for group, values in params.items()
        for (name, value), field in zip(values.items(), dataclasses.fields(getattr(Params(), group)), strict=True)
        if value != default[group][name]
    ]
    return "\n".join(lines + (changed or ["  none"]))
