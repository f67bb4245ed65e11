# SPDX-License-Identifier: Apache-2.0
"""DDS domains that no two tests on this machine have at the same time."""

import errno
import random
import socket
from collections.abc import Iterator
from contextlib import contextmanager

_LAST = 101  # beyond it, DDS ports run into Linux's ephemeral ones


@contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a domain, against other test processes too: the kernel gives a socket name once, until its owner ends."""
    with socket.socket(socket.AF_UNIX) as reservation:
        for domain in random.sample(range(1, _LAST + 1), _LAST):
            try:
                reservation.bind(f"\0cvcdepth test in domain {domain}")
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
            else:
                yield domain
                return
        raise RuntimeError(f"all {_LAST} domains are taken by other tests")
