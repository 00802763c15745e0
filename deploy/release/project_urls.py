"""What the package's page shows: links, and README with links that lead somewhere from there.

FACTORBUS_URL is the address of the project, as https://github.com/OWNER/factorbus.  Without it there are no links of
the project, and those of README stay relative: for an installation from a clone that does not matter.
"""

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class ProjectUrls(MetadataHookInterface):
    """Fills in `urls` and `readme`."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        """Called by the build."""
        text = Path(self.root, "README.md").read_text()
        url = os.environ.get("FACTORBUS_URL", "").rstrip("/")
        if url:
            version = Path(self.root, "proto/factorbus/proto/version.py").read_text().split('"')[-2]
            text = absolute(text, url, f"v{version}")
            metadata["urls"] = {
                "Homepage": url,
                "Documentation": f"{url}/blob/v{version}/README.md",
                "Changelog": f"{url}/blob/v{version}/CHANGELOG.md",
                "Issues": f"{url}/issues",
            }
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute(text: str, url: str, tag: str) -> str:
    """A page in Markdown whose relative links and pictures are those of `tag` at `url`."""

    def link(found: re.Match[str]) -> str:
        picture, label, target = found.groups()
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        return f"{picture}[{label}]({url}/{'raw' if picture else 'blob'}/{tag}/{target})"

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", link, text)
