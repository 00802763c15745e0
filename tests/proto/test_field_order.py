"""The tables of the contract list fields by what they mean: whatever order a message has them in, it says the same."""

import random
from typing import Any

import msgpack
import pytest
from proto import test_asking_codec as asked
from proto import test_codec as whole

PLAIN = [name for name in whole.GOLDEN if whole.message_of(name) and name != whole.WITHOUT_REPORT]


def reordered(content: Any, chance: random.Random) -> Any:
    """The same with the fields of every map in another order; what stands in an array keeps its place."""
    if isinstance(content, dict):
        names = list(content)[::-1]
        chance.shuffle(names)
        return {name: reordered(content[name], chance) for name in names}
    return [reordered(each, chance) for each in content] if isinstance(content, list) else content


@pytest.mark.parametrize("seed", [1, 2])
def test_messages_are_read_in_any_order_of_their_fields(seed: int) -> None:
    chance, other = random.Random(seed), 0
    for name in sorted({*PLAIN, *asked.VECTORS}):
        golden = whole.GOLDEN[name]
        mixed = msgpack.packb(reordered(msgpack.unpackb(golden), chance))
        if name in PLAIN:
            message = whole.message_of(name)
            assert message is not None
            encode, decode = whole.ENCODERS[message], whole.DECODERS[message]
        else:
            encode, decode = asked.codec_of(name)
        assert msgpack.unpackb(encode(decode(mixed))) == msgpack.unpackb(golden), name
        other += mixed != golden
    assert other > 60
