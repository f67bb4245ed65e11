# SPDX-License-Identifier: Apache-2.0
"""A local S3 server (moto's) that counts the bytes it sends."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

BUCKET = "fleet"


@dataclass
class LocalS3:
    """The server, as a test sees it."""

    sent: int = 0
    """Bytes of object content that were sent."""

    def put(self, source: Path, key: str) -> str:
        """Store a file; return its URL."""
        import fsspec

        storage = fsspec.filesystem("s3")
        storage.pipe(f"{BUCKET}/{key}", source.read_bytes())
        storage.invalidate_cache()
        return f"s3://{BUCKET}/{key}"


@contextmanager
def local_s3() -> Iterator[LocalS3]:
    """Run the server, and have fsspec's s3:// URLs lead to it, in child processes too."""
    import fsspec
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log(self, *_: object) -> None:
            pass

    state = LocalS3()
    application = _counting(DomainDispatcherApplication(create_backend_app), state)
    server = make_server("127.0.0.1", 0, application, threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    environment = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with patch.dict(os.environ, environment):
        fsspec.filesystem("s3").clear_instance_cache()
        fsspec.filesystem("s3").mkdir(BUCKET)
        yield state
        # moto keeps its buckets for the whole process, so the next server would find this one's.
        fsspec.filesystem("s3").rm(BUCKET, recursive=True)
        fsspec.filesystem("s3").clear_instance_cache()
    server.shutdown()
    thread.join()
    server.server_close()


def _counting(application: Any, state: LocalS3) -> Any:
    """Count what is sent of objects; listings, which have no key, are left out."""

    def counting(environ: dict[str, Any], start_response: Any) -> Iterator[bytes]:
        is_object = environ["REQUEST_METHOD"] == "GET" and environ["PATH_INFO"].strip("/").count("/") > 0
        for part in application(environ, start_response):
            state.sent += len(part) if is_object else 0
            yield part

    return counting
