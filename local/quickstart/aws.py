"""Runs the AWS stand-in in a Pod of examples/quickstart.yaml: ministack, and in it what that manifest names. Ends when ministack does."""

import os
import signal
import subprocess
import sys
import time
import urllib.request

PORT = 4566
ENDPOINT = f"http://127.0.0.1:{PORT}"
PAUSE, PATIENCE = 0.2, 60
# For ministack, and for the client that makes the resources.
SETTINGS = {
    "BIND_HOST": "0.0.0.0",
    "GATEWAY_PORT": str(PORT),
    # In the queue URLs that it hands out: the name of the Service.
    "MINISTACK_HOST": "aws",
    # It runs code for anyone who asks (Lambda and others): only what the operator needs is served.
    "SERVICES": "sqs,s3,dynamodb,logs,sts",
    "STATE_DIR": "/tmp/state",
    "S3_DATA_DIR": "/tmp/state/s3",
    "LOG_LEVEL": "WARNING",
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_ENDPOINT_URL": ENDPOINT,
}


def answers() -> bool:
    try:
        with urllib.request.urlopen(f"{ENDPOINT}/_ministack/health", timeout=2) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


def main() -> int:
    os.environ.update(SETTINGS)
    server = subprocess.Popen([sys.executable, "-m", "ministack"])
    # The first process of a container ignores what it has no handler for.
    signal.signal(signal.SIGTERM, lambda *_: server.terminate())
    began = time.monotonic()
    while not answers():
        if server.poll() is not None or time.monotonic() - began > PATIENCE:
            server.kill()
            sys.exit(f"ministack does not answer at {ENDPOINT}")
        time.sleep(PAUSE)
    # It needs the variables above.
    import aws_resources

    aws_resources.main(["quickstart"])
    print(f"queues, tables, log group and bucket are there ({time.monotonic() - began:.1f} s)", flush=True)
    return server.wait()


if __name__ == "__main__":
    sys.exit(main())
