"""Open pages from files in a headless Firefox: Debian's build, driven by WebDriver BiDi over a WebSocket.

Playwright drives only its own build of Firefox. This client implements the part of RFC 6455 that tests need: text
messages, sent as one frame each, and received as any number of frames.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

PATIENCE = 120  # seconds
_PREFERENCES = {
    "webgl.force-enabled": True,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "app.update.enabled": False,
    "app.normandy.enabled": False,
}
_TEXT, _CLOSE, _LAST, _MASKED = 1, 8, 0x80, 0x80


class Firefox:
    """A session with one tab."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)
        self._read, self._number = self._socket.makefile("rb"), 0
        self.log: list[str] = []
        key = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
        head = f"GET /session HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{key}Sec-WebSocket-Version: 13\r\n\r\n"
        self._socket.sendall(head.encode())
        assert b" 101 " in self._read.readline()
        while self._read.readline().strip():
            pass
        self.send("session.new", capabilities={})
        self.send("session.subscribe", events=["log.entryAdded"])
        self._tab = self.send("browsingContext.getTree")["contexts"][0]["context"]

    def send(self, method: str, **parameters: Any) -> Any:
        """Send a command and return the result from the browser."""
        self._number += 1
        self._write(json.dumps({"id": self._number, "method": method, "params": parameters}).encode())
        while True:
            answer = json.loads(self._message())
            if answer.get("method") == "log.entryAdded":
                self.log.append(answer["params"]["text"])
            if answer.get("id") == self._number:
                assert answer["type"] == "success", answer
                return answer["result"]

    def close(self) -> None:
        self._read.close()
        self._socket.close()

    def open(self, path: Path) -> None:
        self.send("browsingContext.navigate", context=self._tab, url=path.as_uri(), wait="complete")

    def ask(self, script: str) -> Any:
        """Evaluate a script and return its value: text, a number or a boolean."""
        found = self.send("script.evaluate", expression=script, target={"context": self._tab}, awaitPromise=True)
        assert found["type"] == "success", found
        return found["result"].get("value")

    def wait_for(self, script: str) -> None:
        end = time.monotonic() + PATIENCE
        while not self.ask(script):
            assert time.monotonic() < end, (script, self.log)
            time.sleep(0.1)

    def _write(self, text: bytes) -> None:
        size = len(text)
        length = bytes([_MASKED | size]) if size < 126 else bytes([_MASKED | 126]) + size.to_bytes(2, "big")
        mask = b"mask"  # the browser rejects a mask of zeros
        hidden = bytes(byte ^ mask[i % 4] for i, byte in enumerate(text))
        self._socket.sendall(bytes([_LAST | _TEXT]) + length + mask + hidden)

    def _message(self) -> bytes:
        whole, last = b"", False
        while not last:
            first, length = self._read.read(2)
            assert first & 15 != _CLOSE, "the browser has gone"
            if length > 125:
                length = int.from_bytes(self._read.read(2 if length == 126 else 8), "big")
            whole, last = whole + self._read.read(length), bool(first & _LAST)
        return whole


@contextmanager
def firefox(folder: Path) -> Iterator[Firefox]:
    """Start the browser with a new profile in a folder. Skips the test if Firefox or Xvfb is not installed."""
    program, display = shutil.which("firefox-esr"), shutil.which("xvfb-run")
    if program is None or display is None:
        pytest.skip("no firefox-esr and xvfb: `make tools` installs them")
    profile = folder / "profile"
    profile.mkdir()
    lines = [f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in _PREFERENCES.items()]
    (profile / "user.js").write_text("".join(lines))
    options = ["--headless", "--no-remote", "--profile", str(profile), "--remote-debugging-port=0"]
    said = folder / "said.txt"
    with said.open("wb") as log:
        command, home = [display, "-a", program, *options], {**os.environ, "HOME": str(folder)}
        running = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=home)
    try:
        with closing(Firefox(_port(said))) as session:
            yield session
    finally:
        os.killpg(running.pid, signal.SIGTERM)
        running.wait(PATIENCE)


def _port(said: Path) -> int:
    """Return the port that the browser prints to its log."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        for line in said.read_text(errors="replace").splitlines():
            if "WebDriver BiDi listening on ws://" in line:
                return int(line.rpartition(":")[2])
        time.sleep(0.1)
    raise AssertionError(f"Firefox does not listen: {said.read_text(errors='replace')[-500:]}")
