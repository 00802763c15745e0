"""A Zenoh router in a process of its own, as zenohd would be: router.py ENDPOINT [CONFIGURATION] → `ready ENDPOINT`"""

import json
import sys

import zenoh


def main() -> None:
    """Route until standard input closes."""
    config = zenoh.Config.from_file(sys.argv[2]) if len(sys.argv) > 2 else zenoh.Config()
    for path, value in {
        "mode": "router",
        "listen/endpoints": [sys.argv[1]],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "adminspace/enabled": True,
    }.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        for reply in session.get(f"@/{session.info.zid()}/router", timeout=60.0):
            if reply.ok is not None:
                print("ready", *json.loads(reply.ok.payload.to_bytes())["locators"], flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
