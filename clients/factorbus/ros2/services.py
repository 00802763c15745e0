"""What an operator on ROS asks of a map: services of the type std_srvs/Trigger, answered one after the other on a
thread of their own, so that odometry goes on meanwhile.

    ~/settle   iterate until the map has converged
    ~/save     write the map (.g2o) and this robot's trajectory (.tum) into a folder
    ~/fork     a new map that begins as this one is now
    ~/repair   which loop closures are false; nothing is changed
    ~/accept   take out what the last repair has found
    ~/reject   leave it in
"""

import logging
import queue
import threading
from collections.abc import Callable
from pathlib import Path

from factorbus.client import Bus, Changes, Map, Problem
from factorbus.proto.asking import Repaired
from factorbus.ros2.messages import Messages
from factorbus.ros2.names import Topic
from factorbus.ros2.node import Node, ServiceCall
from factorbus.ros2.trigger import RESPONSE, TRIGGER
from factorbus.wording import counted

log = logging.getLogger("factorbus.ros2")

_BACKLOG = 16  # calls that may wait
_LONGEST_S, _PATIENCE_S = 600.0, 5.0
_NAME_LENGTH = 64  # of a map
_SHOWN = 8
_DEPTH = 10  # as of services by default


class MapServices:
    """Of one map; use it in `with`.  folder: where files are saved; letter: whose trajectory."""

    def __init__(self, bus: Bus, joined: Map, folder: Path | None, letter: str) -> None:
        self._bus, self._map, self._folder, self._letter = bus, joined, folder, letter
        self._found: Repaired | None = None
        self._calls: queue.Queue[tuple[str, ServiceCall] | None] = queue.Queue(_BACKLOG)
        self._thread = threading.Thread(target=self._run, name="factorbus-ros2-services", daemon=True)
        self._messages: Messages | None = None
        self._does: dict[str, Callable[[], str]] = {
            "settle": self._settle, "save": self._save, "fork": self._fork, "repair": self._repair,
            "accept": self._accept, "reject": self._reject,
        }  # fmt: skip

    def offer(self, node: Node, messages: Messages) -> "MapServices":
        """Be there for calls, under the node's name; answered while inside `with`."""
        self._messages = messages
        for name in self._does:
            topic = Topic(f"{node.full_name}/{name}", TRIGGER, messages.hash(TRIGGER), _DEPTH)
            node.serve(topic, lambda call, name=name: self._hear(name, call))
        return self

    def __enter__(self) -> "MapServices":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._calls.put(None)
        self._thread.join(_PATIENCE_S)  # a map that settles is not waited for

    def answer(self, name: str) -> tuple[bool, str]:
        """(whether it was done, what was done or why not)."""
        try:
            return True, self._does[name]()
        except Problem as problem:
            return False, f"{problem.message} [{problem.code}]"
        except _NotDone as why:
            return False, str(why)
        except OSError as error:
            return False, f"{error.filename}: {error.strerror}; see --save-folder"

    def _hear(self, name: str, call: ServiceCall) -> None:
        """On Zenoh's thread: it may only hand over."""
        try:
            self._calls.put_nowait((name, call))
        except queue.Full:
            self._reply(call, False, f"{_BACKLOG} calls wait already; call again later")

    def _run(self) -> None:
        while (each := self._calls.get()) is not None:
            name, call = each
            done, text = self.answer(name)
            log.log(logging.INFO if done else logging.WARNING, "service %s: %s", name, text)
            self._reply(call, done, text)

    def _reply(self, call: ServiceCall, done: bool, text: str) -> None:
        if self._messages is None:
            raise ValueError("a call of a service that was not offered")
        call.reply(self._messages.write(RESPONSE, self._messages.type_of(RESPONSE)(done, text)))

    def _settle(self) -> str:
        accepted = self._map.settle(timeout_s=_LONGEST_S)
        return f"settled at revision {accepted.revision}, χ² {self._map.chi2().chi2:.6g}"

    def _save(self) -> str:
        if self._folder is None:
            raise _NotDone("no folder to save into; start the bridge with --save-folder DIR")
        revision = self._map.estimate.revision
        texts = {".g2o": self._map.export("g2o"), ".tum": self._map.export("tum", robot=self._letter)}
        self._folder.mkdir(parents=True, exist_ok=True)
        paths = [self._folder / f"{self._map.name}-r{revision}{ending}" for ending in texts]
        for path, text in zip(paths, texts.values(), strict=True):
            beside = path.with_name(f".{path.name}.part")
            beside.write_text(text, encoding="utf-8")
            beside.replace(path)
        return " ".join(map(str, paths))

    def _fork(self) -> str:
        ending = f"-r{self._map.estimate.revision}"
        row = self._bus.fork(self._map.name, self._map.name[: _NAME_LENGTH - len(ending)] + ending)
        return f"map {row.name} begins as {self._map.name} is at revision {row.revision}"

    def _repair(self) -> str:
        found = self._map.repair(timeout_s=_LONGEST_S)
        self._found = found if found.factors.size else None
        looked = f"of {counted(found.suspects, 'loop closure')}"
        if self._found is None:
            return f"none {looked} is false"
        shown = ", ".join(map(str, found.factors[:_SHOWN].tolist()))
        more = ", …" if found.factors.size > _SHOWN else ""
        costs = f"the map costs {found.before:.4g}, and {found.after:.4g} without"
        return f"{found.factors.size} {looked} are false (factors {shown}{more}); {costs}: accept or reject"

    def _accept(self) -> str:
        found = self._proposed()
        changes = Changes().remove_factors(found.factors.tolist()).place(found.variables, carry=True)
        accepted = self._map.change(changes, settle=True, timeout_s=_LONGEST_S)
        self._found = None
        return f"{counted(found.factors.size, 'factor')} taken out at revision {accepted.revision}"

    def _reject(self) -> str:
        found = self._proposed()
        self._found = None
        return f"{counted(found.factors.size, 'factor')} left in"

    def _proposed(self) -> Repaired:
        if self._found is None:
            raise _NotDone("nothing is proposed; call repair first")
        return self._found


class _NotDone(Exception):
    """Why a service does nothing, in words."""
