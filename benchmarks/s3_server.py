"""An S3 server on this machine (moto's) in a process of its own, for tests and measurements."""

import contextlib
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Generator

from registry.errors import EnvironmentMissing

_WAIT_S = 60.0


@contextlib.contextmanager
def s3_server(bucket: str) -> Generator[dict[str, str], None, None]:
    """Run a server with an empty bucket while the block runs.

    Yields:
        The environment variables by which clients find it. They are set in this process, too.

    Raises:
        EnvironmentMissing: moto, flask or s3fs is not installed, or the server does not start.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    try:
        import s3fs
    except ImportError as error:
        raise EnvironmentMissing("S3: pip install 'simrecon[dev]'") from error
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    try:
        _wait(process, settings["AWS_ENDPOINT_URL"])
        s3fs.S3FileSystem.clear_instance_cache()  # clients of another server
        s3fs.S3FileSystem(use_listings_cache=False).mkdir(bucket)
        yield settings
    finally:
        process.kill()
        process.wait()
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
        s3fs.S3FileSystem.clear_instance_cache()  # its clients keep this server's address


def _wait(process: subprocess.Popen, address: str) -> None:
    end = time.monotonic() + _WAIT_S
    while time.monotonic() < end and process.poll() is None:
        with contextlib.suppress(OSError), urllib.request.urlopen(f"{address}/moto-api/data.json"):
            return
        time.sleep(0.1)
    raise EnvironmentMissing("S3: moto's server does not start; pip install 'simrecon[dev]'")
