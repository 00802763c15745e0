"""Where things are on the bus: key expressions of wire version 1.

    factorbus/v1/map/<map>/in/<client>                  query        an insert
    factorbus/v1/map/<map>/ask/<question>               query        estimate, chi2, graph, ...: QUESTIONS
    factorbus/v1/map/<map>/out/{delta,snapshot,event}   publication
    factorbus/v1/map/<map>/out/interest-<id>            publication  of one interest
    factorbus/v1/map/<map>/records/<replica>            query        records of a replica's journal
    factorbus/v1/map/<map>/live/{service,client}/<id>   liveliness token
    factorbus/v1/worker/<id>/job                        query
    factorbus/v1/worker/<id>/live/<slots>               liveliness token
    factorbus/v1/features/<service>/ask                 query
    factorbus/v1/features/<service>/live                liveliness token
    factorbus/v1/admin/{maps,stats,create,fork,drop}    query

Maps sit below `map/`, so that no map name can collide with `worker` or `admin`.
"""

import re

from factorbus.proto.problems import BadName

VERSION = "v1"
PREFIX = f"factorbus/{VERSION}"
# The one key that is the same in every version, so that versions can be told apart.
ANY_SERVICE_OF_ANY_VERSION = "factorbus/*/features/*/live"
QUESTIONS = (
    "estimate", "chi2", "graph", "stats", "export", "covariance", "gate", "associate", "gain", "why", "repair",
    "interest", "records", "suspects", "history", "components",
)  # fmt: skip
LONGEST_NAME = 64
_NAME = re.compile(r"[A-Za-z0-9_-]+")


def checked_name(what: str, name: str, most: int = LONGEST_NAME) -> str:
    """`name`, if it may stand in a key.  Raises BadName; `what` says whose name it is, `most` how long it may be."""
    if not is_name(name, most):
        raise BadName(what, name, most)
    return name


def is_name(name: object, most: int = LONGEST_NAME) -> bool:
    """Whether `name` may stand in a key."""
    return isinstance(name, str) and len(name) <= most and _NAME.fullmatch(name) is not None


def map_root(name: str) -> str:
    """Everything of one map lies below this.  Raises BadName."""
    return f"{PREFIX}/map/{checked_name('map', name)}"


def insert_key(map_name: str, client: str) -> str:
    """Where `client` sends its inserts.  Raises BadName."""
    return f"{map_root(map_name)}/in/{checked_name('client', client)}"


def inserts_of_any_client(map_name: str) -> str:
    """What the owner of a map answers inserts on."""
    return f"{map_root(map_name)}/in/*"


def client_of(key: str) -> str:
    """The client that the key of an insert, or of its token, names: the last chunk."""
    return key.rpartition("/")[2]


def ask_key(map_name: str, question: str) -> str:
    """Where `question` is asked."""
    return f"{map_root(map_name)}/ask/{question}"


def any_question(map_name: str) -> str:
    """What the owner of a map answers questions on."""
    return f"{map_root(map_name)}/ask/*"


def below_map(key: str) -> tuple[str, str]:
    """(map, what stands behind in/, ask/ or records/) of a key or pattern, such as `factorbus/**`."""
    parts = key.split("/")
    return parts[min(3, len(parts) - 1)], "/".join(parts[5:]) or parts[-1]


def records_key(map_name: str, replica: str) -> str:
    """Where `replica` sends the records of its journal.  Raises BadName."""
    return f"{map_root(map_name)}/records/{checked_name('replica', replica)}"


def delta_key(map_name: str) -> str:
    """Where every step's changes are published."""
    return f"{map_root(map_name)}/out/delta"


def snapshot_key(map_name: str) -> str:
    """Where the whole estimate is published now and then."""
    return f"{map_root(map_name)}/out/snapshot"


def channel_key(map_name: str, channel: str) -> str:
    """Where `channel` of a map is published: `delta`, or that of an interest."""
    return f"{map_root(map_name)}/out/{checked_name('channel', channel)}"


def event_key(map_name: str) -> str:
    """Where things that happen to the map, other than steps, are published."""
    return f"{map_root(map_name)}/out/event"


def service_token(map_name: str, service: str) -> str:
    """Alive while `service` owns the map and answers for it."""
    return f"{map_root(map_name)}/live/service/{checked_name('service', service)}"


def client_token(map_name: str, client: str) -> str:
    """Alive while `client` has joined the map."""
    return f"{any_client_token(map_name)[:-1]}{checked_name('client', client)}"


def any_client_token(map_name: str) -> str:
    """Those of all clients of a map."""
    return f"{map_root(map_name)}/live/client/*"


def job_key(worker: str) -> str:
    """Where one worker takes its jobs: a key per worker, because the bus does not balance load."""
    return f"{PREFIX}/worker/{checked_name('worker', worker)}/job"


def worker_token(worker: str, slots: int) -> str:
    """Alive while `worker` takes up to `slots` jobs at a time."""
    return f"{PREFIX}/worker/{checked_name('worker', worker)}/live/{slots}"


def any_worker_token() -> str:
    """Matches every worker's token."""
    return f"{PREFIX}/worker/*/live/*"


def worker_of(token: str) -> tuple[str, int]:
    """(worker, slots) of a worker's token."""
    parts = token.split("/")
    return parts[-3], int(parts[-1])


def admin_key(operation: str) -> str:
    """Where `operation` (maps, create, drop) on the set of maps is asked for."""
    return f"{PREFIX}/admin/{operation}"


def features_key(service: str) -> str:
    """Where `service` is asked for features, without a map."""
    return f"{PREFIX}/features/{checked_name('service', service)}/ask"


def features_token(service: str) -> str:
    """Alive while `service` answers for features."""
    return f"{PREFIX}/features/{checked_name('service', service)}/live"


def any_features_token() -> str:
    """Matches every service's token for features."""
    return f"{PREFIX}/features/*/live"


def version_of(key: str) -> str:
    """The version of the protocol that a key belongs to, such as `v1`."""
    return key.split("/")[1]


def service_of(token: str) -> str:
    """The service that a token for features names."""
    return token.split("/")[-2]
