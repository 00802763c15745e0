"""A gateway as a program or a page speaks with it: questions, edits, and what it refuses them with."""

import json
import urllib.error
import urllib.request
from typing import Any

from factorbus.client import Draft

MERGED = {"other": "yard", "sigmas": [0.1, 0.1, 0.05]}


class Editor:
    """Somebody at map `name` of the gateway at `address`; token: who they are."""

    def __init__(self, address: str, name: str, token: str = "") -> None:
        self.root = f"{address}/api/maps/{name}"
        self.who = {"Authorization": f"Bearer {token}"} if token else {}

    def ask(self, path: str) -> Any:
        """The answer to GET, as JSON."""
        return self._answer(urllib.request.Request(f"{self.root}/{path}", headers=self.who))

    def edit(self, edit: str, **fields: Any) -> Any:
        """What came of an edit.  Raises HTTPError."""
        return self.post(json.dumps({"edit": edit, **fields}).encode())

    def post(self, body: bytes, **headers: str) -> Any:
        """The same of bytes; headers with _ for -, those that are empty are left out.  Raises HTTPError."""
        usual = {"Content-Type": "application/json", "X-Factorbus-Token": self.ask("session")["token"]} | self.who
        given = {name.replace("_", "-"): text for name, text in headers.items()}
        sent = {name: text for name, text in (usual | given).items() if text}
        return self._answer(urllib.request.Request(f"{self.root}/edits", body, sent))

    def factor_between(self, *keys: str) -> int:
        """The id of the factor between these variables."""
        return next(
            group["ids"][group["keys"].index(list(keys))]
            for group in self.ask("edges")["factors"]
            if list(keys) in group["keys"]
        )

    @staticmethod
    def _answer(request: urllib.request.Request) -> Any:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)


def problem_of(error: urllib.error.HTTPError) -> dict[str, Any]:
    """What an answer that is none says."""
    with error:
        return {"status": error.code, **json.load(error)["problem"]}


def square(false_closure: bool = False, letter: str = "x") -> Draft:
    """A robot that drives four metres around a square, twice, and sees that it is back; falsely, too, if asked for."""
    draft = Draft().se2(f"{letter}0", (0, 0, 0), fixed=True)
    sure = {"sigmas": (0.05, 0.05, 0.02)}
    for i in range(16):
        draft.se2(f"{letter}{i + 1}")
        draft.between_se2(f"{letter}{i}", f"{letter}{i + 1}", (1.0, 0, 1.570796 if i % 4 == 3 else 0.0), **sure)  # type: ignore[arg-type]
    draft.between_se2(f"{letter}0", f"{letter}16", (0, 0, 0), **sure)  # type: ignore[arg-type]
    if false_closure:
        draft.between_se2(f"{letter}2", f"{letter}10", (0, 0, 0), **sure)  # type: ignore[arg-type]
    return draft


def arc(poses: int = 12) -> Draft:
    """A robot that drives in a bow and comes nowhere twice: a click means one pose."""
    draft = Draft().se2("x0", (0, 0, 0), fixed=True)
    for i in range(poses - 1):
        draft.se2(f"x{i + 1}").between_se2(f"x{i}", f"x{i + 1}", (1.0, 0, 0.3), sigmas=(0.05, 0.05, 0.02))
    return draft
