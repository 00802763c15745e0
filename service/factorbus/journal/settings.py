"""A setting of a map that its journal has, changed while the map is there."""

import json
from typing import Any

from factorbus.journal.store import Store


def note_option(store: Store, name: str, value: Any | None) -> None:
    """The map has `value` for option `name` from now on; None: it has none.  Only of options that change no step which
    is in the journal: records are run again with what the header says at last.

    Raises JournalDamaged, JournalFailed: then nothing has changed.
    """
    options = {each: had for each, had in store.header().options.items() if each != name}
    if value is not None:
        options[name] = value
    with store._writing():
        store._set({"options": json.dumps(options)})
        store._seal()
