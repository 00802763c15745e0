"""An answer of `ask/why` in words, for a person.  Of open maps, what is not there is not said."""

from collections.abc import Iterator, Mapping
from typing import Any

from factorbus.proto.kinds import name_of_kind
from factorbus.proto.symbols import format_symbol
from factorbus.wording import counted

_SHOWN = 8


def why_text(revision: int, variable: Mapping[str, Any], factor: Mapping[str, Any], step: Mapping[str, Any]) -> str:
    """Lines about a variable and its factors, those that fit worst first, or about one factor; then the last step."""
    if variable:
        lines = [*_of_variable(revision, variable, step)]
    else:
        lines = [f"{_of_factor(factor, step)}, at revision {revision}"]
    if "because" in step:
        lines.append(f"last step: {step.get('strategy', '')}, because {step['because']}")
    return "\n".join(lines)


def why_symbols(variable: Mapping[str, Any], factor: Mapping[str, Any]) -> tuple[str, ...]:
    """The variables that are named, as they print, each once."""
    factors = variable.get("factors", ()) if variable else (factor,)
    keys = [variable["key"]] if "key" in variable else []
    keys += [key for each in factors for key in each.get("keys", ())]
    return tuple(dict.fromkeys(format_symbol(int(key)) for key in keys))


def fall_without(without: float, step: Mapping[str, Any]) -> str:
    """By how much χ² falls without a factor, to first order, after a step with this report.

    No fall is more than all of χ², and first order knows nothing of that.
    """
    whole = step.get("chi2")
    if whole is None or without <= whole or f"{without:.3g}" == f"{whole:.3g}":
        return f"about {without:.3g}"
    return f"at most {whole:.3g}, which is all of χ² ({without:.3g} to first order)"


def _of_variable(revision: int, variable: Mapping[str, Any], step: Mapping[str, Any]) -> Iterator[str]:
    name, fixed = format_symbol(int(variable["key"])), ", fixed" if variable.get("fixed") else ""
    yield f"{name}, {variable.get('kind', 'a variable')}{fixed}, at revision {revision}"
    for what in ("value", "sigmas"):
        if what in variable:
            yield f"{what}: {'  '.join(f'{number:.4g}' for number in variable[what])}"
    factors = sorted(variable.get("factors", ()), key=lambda each: -float(each.get("chi2") or 0.0))
    yield from (_of_factor(each, step) for each in factors[:_SHOWN])
    if len(factors) > _SHOWN:
        yield f"and {counted(len(factors) - _SHOWN, 'factor')} more"


def _of_factor(factor: Mapping[str, Any], step: Mapping[str, Any]) -> str:
    ends = ", ".join(format_symbol(int(key)) for key in factor.get("keys", ()))
    told = f"factor {factor.get('factor', '?')}, {name_of_kind(factor.get('kind', ''))} ({ends})"
    if factor.get("chi2") is not None:
        told += f": χ² {factor['chi2']:.3g}"
    if factor.get("without") is not None:
        told += f", without it χ² falls by {fall_without(factor['without'], step)}"
    return told
