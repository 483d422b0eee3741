"""``tactile view``: serve the live page of running daemons, or of a log."""

from __future__ import annotations

import argparse
import asyncio
import errno
import logging
import os
import signal
import socket
import sys
from typing import TYPE_CHECKING

from tactile_core.bus.session import BusError
from tactile_core.options import BusTable, bus_config
from tactile_tools.view.guard import Guard, is_loopback, make_token

if TYPE_CHECKING:
    from tactile_tools.view.live import LiveSource
    from tactile_tools.view.player import LogPlayer

DONE, FAILED, USAGE, REFUSED = range(4)

PORT = 8420

LEAST_TOKEN = 16
"""Fewest characters of a token given by the user."""

EPILOG = f"""\
examples:
  tactile view                       the boards of this machine, at http://127.0.0.1:{PORT}
  tactile view FILE.mcap             a log, with a slider
  tactile view --bind 0.0.0.0        for other machines, with a token in the address
  ssh -L {PORT}:127.0.0.1:{PORT} robot    the page of another machine, without opening it

exit status: 0 ended on request; 2 bad argument, or a log without anything to show; 3 the port is
in use or cannot be had.
"""


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    loopback = is_loopback(options.bind)
    token = options.token
    if token is not None and (len(token) < LEAST_TOKEN or not token.isalnum()):
        # Letters and digits need no quoting in an address or a cookie.
        return _complain(
            f"--token of {len(token)} characters; allowed: at least {LEAST_TOKEN} letters and "
            "digits; without --token one is made",
            USAGE,
        )
    if not loopback and token is None:
        token = make_token()
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # strangers' errors
    from tactile_tools.view.player import PlayError

    try:
        source = _source(options)
    except PlayError as error:
        return _complain(str(error), USAGE)
    except BusError as error:
        return _complain(str(error), USAGE)
    names = {name.lower() for name in (*options.host_name, socket.gethostname())}
    guard = Guard(options.port, token, frozenset(names))
    try:
        return asyncio.run(_serve(source, guard, options, loopback))
    except OSError as error:
        return _complain(_port_trouble(error, options), REFUSED)
    except KeyboardInterrupt:
        return DONE


def _source(options: argparse.Namespace) -> LiveSource | LogPlayer:
    if options.log:
        from tactile_tools.view.player import LogPlayer

        return LogPlayer(options.log)
    from tactile_tools.view.live import LiveSource

    return LiveSource(bus_config(options, BusTable(), "tool"))


async def _serve(
    source: LiveSource | LogPlayer, guard: Guard, options: argparse.Namespace, loopback: bool
) -> int:
    from tactile_tools.view.live import LiveSource
    from tactile_tools.view.server import PageServer

    server = PageServer(source, guard, read_only=options.read_only, loopback=loopback)
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopping.set)
    if options.until_stdin_ends:
        loop.add_reader(sys.stdin.fileno(), lambda: _read_end(stopping))
    port = await server.start(options.bind, options.port)
    shown = f"[{options.bind}]" if ":" in options.bind else options.bind
    if shown in ("0.0.0.0", "[::]"):
        shown = socket.gethostname()
    print(f"http://{shown}:{port}/" + (f"?token={guard.token}" if guard.token else ""), flush=True)
    running = asyncio.create_task(server.run())
    waiting = asyncio.create_task(stopping.wait())
    try:
        await asyncio.wait((running, waiting), return_when=asyncio.FIRST_COMPLETED)
        if running.done():
            running.result()
    finally:
        running.cancel()
        waiting.cancel()
        await server.close()
        if isinstance(source, LiveSource):
            source.close()
    return DONE


def _read_end(stopping: asyncio.Event) -> None:
    """Stop when the process that started this page has ended, for whatever reason."""
    try:
        if os.read(sys.stdin.fileno(), 4096):
            return
    except OSError:
        pass
    stopping.set()
    asyncio.get_running_loop().remove_reader(sys.stdin.fileno())


def _port_trouble(error: OSError, options: argparse.Namespace) -> str:
    where = f"{options.bind}:{options.port}"
    if error.errno == errno.EADDRINUSE or "in use" in str(error):
        return (
            f"port {options.port} is in use (another page may be open already at "
            f"http://{options.bind}:{options.port}): name another with --port, or 0 for any"
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"{where} is not permitted: name a --port above 1023"
    return f"cannot serve at {where}: {error.strerror or error}; name another --bind or --port"


def _complain(text: str, code: int) -> int:
    print(f"tactile view: {text}", file=sys.stderr)
    return code


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text} given; allowed: a port from 0 to 65535")
    return int(text)
