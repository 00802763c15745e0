"""Whether this client may insert into a map: access control drops what it denies, without a word.

So it is tried with an insert that cannot happen.  It names an epoch that is not the map's, which the service refuses
before it looks at anything else; where nothing comes back at all, the bus has dropped it.
"""

from factorbus.client.request_sender import Request, RequestSender
from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Insert
from factorbus.proto.problems import Refused, Unavailable, WrongEpoch


def inserts_pass(sender: RequestSender, name: str, client: str, epoch: int, timeout_s: float) -> bool:
    """Whether an insert of `client` reaches the service that keeps map `name`, of which it is known to answer.

    Raises Refused where it is refused for another reason than its epoch, as by a service that stops.
    """
    payload = codec.encode_insert(Insert(1, Batch(), epoch=epoch ^ 1 or 2))  # 0 would be any epoch
    asked = Request(f"map {name!r}", keys.insert_key(name, client), payload, codec.decode_accepted, timeout_s)
    try:
        sender.carry(asked).future.result()
    except Unavailable:
        return False
    except Refused as refused:
        if refused.code != WrongEpoch.code:
            raise
    return True
