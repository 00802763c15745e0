"""--params-file: the options of a node from a parameters file of ROS 2.  What is typed counts before it."""

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output.exits import input_file, require
from factorbus.cli.process.options import PATH

# A clock of the robot's is not looked at; every file of a simulated robot has it.
_WITHOUT_EFFECT = ("use_sim_time",)
_NOT_PARAMETERS = ("help", "params_file", "node", "namespace", "until_eof")


class NodeCommand(click.Command):
    """A command whose options may be in a file: pose_graph for --pose-graph, and map for MAP."""

    def parameters(self) -> dict[str, click.Parameter | None]:
        """What may be in the file, by name; None: it has no effect here."""
        return {_parameter(each): each for each in self.params if _parameter(each) not in _NOT_PARAMETERS}

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Reads the file first, as the values that options have unless they are typed."""
        if not ctx.resilient_parsing and "--help" not in args:
            typed, _, _ = self.make_parser(ctx).parse_args(list(args))
            if (file := typed.get("params_file")) is not None:
                ctx.default_map = self._read(Path(file), str(typed.get("namespace", "/")), typed)
        return super().parse_args(ctx, args)

    def _read(self, path: Path, namespace: str, typed: Mapping[str, Any]) -> dict[str, Any]:
        require("ros2", f"factorbus {self.name} --params-file")
        from factorbus.ros2.parameters import BadParameters, node_parameters

        known = self.parameters()
        with input_file(path):
            given = node_parameters(path, namespace, str(typed.get("node_name", "factorbus")))
        found: dict[str, Any] = {}
        for name, value in given.items():
            if name in _WITHOUT_EFFECT:
                continue
            if name not in known:
                near = get_close_matches(name, known, 1) or sorted(known)
                raise BadParameters(path, f"{name} is no parameter", " or ".join(near))
            if (option := known[name]) is not None:
                found[str(option.name)] = _as_typed(path, option, name, value)
        return found


def _parameter(option: click.Parameter) -> str:
    """By what an option goes in a file: without its dashes."""
    if isinstance(option, click.Argument):
        return "map"
    return max(option.opts, key=len).lstrip("-").replace("-", "_")


def _as_typed(path: Path, option: click.Parameter, name: str, value: Any) -> Any:
    """A value of YAML as click wants it.  Raises BadParameters: it is of another form."""
    from factorbus.ros2.parameters import BadParameters

    if getattr(option, "is_flag", False):
        if not isinstance(value, bool):
            raise BadParameters(path, f"{name}: {value!r}", "true or false")
        return value
    values = value if isinstance(value, list) else [value]
    several = getattr(option, "multiple", False)
    if option.nargs != 1 and len(values) != option.nargs:
        raise BadParameters(path, f"{name}: {value!r}", f"a list of {option.nargs} numbers")
    if not several and option.nargs == 1 and isinstance(value, list):
        raise BadParameters(path, f"{name}: {value!r}", "one value")
    for each in values:
        if not isinstance(each, (str, int, float)) or isinstance(each, bool):
            raise BadParameters(path, f"{name}: {each!r}", "a list of values" if several else "one value")
    texts = [str(each) for each in values]
    return texts if several or option.nargs != 1 else texts[0]


def params_file_option(command: Any) -> Any:
    """--params-file, which `NodeCommand` reads."""
    return click.option(
        "--params-file", type=PATH, metavar="FILE.yaml", expose_value=False,
        help="Options from a parameters file of ROS 2, such as pose_graph: /graph; what is typed counts first.",
    )(command)  # fmt: skip
