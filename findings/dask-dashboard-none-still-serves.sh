#!/usr/bin/env bash
# Dask distributed 2026.8.0: LocalCluster(dashboard_address=None) still serves its pages.
#
# The docstring of LocalCluster says of dashboard_address: "Set to None to disable the dashboard."
# Only the plots of Bokeh are left out.  An HTTP server is started all the same, at the default
# port 8787 or, where that is taken, at any other, and it serves /health and /info/main/workers.html
# with the workers' tasks; where no host is given (processes=False) it does so on all interfaces.
#
# Seen, with 2026.8.0 on Python 3.11:
#   /health: 200 b'ok'
#   /info/main/workers.html: 200, a page of HTML
#   addresses: 0.0.0.0 and ::
# What helps: dask.config.set({"distributed.scheduler.http.routes": []}), after which both are 404.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet distributed==2026.8.0 dask==2026.8.0 psutil==7.0.0
cd "$folder"
cat > served.py <<'PY'
import urllib.error
import urllib.request

import dask
import psutil
from distributed import LocalCluster


def answers():
    with LocalCluster(n_workers=1, processes=False, dashboard_address=None) as cluster:
        port = cluster.scheduler.http_server.port
        found = {}
        for page in ("health", "info/main/workers.html"):
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=10) as got:
                    found[page] = got.status
            except urllib.error.HTTPError as error:
                found[page] = error.code
        connections = psutil.Process().net_connections()
        at = {one.laddr.ip for one in connections if one.laddr and one.laddr.port == port}
    return found, at & {"0.0.0.0", "::"}


usual, everywhere = answers()
print("dashboard_address=None:", usual, "on", sorted(everywhere))
with dask.config.set({"distributed.scheduler.http.routes": []}):
    without, _ = answers()
print("and without routes:", without)
assert set(usual.values()) == {200} and "0.0.0.0" in everywhere
assert set(without.values()) == {404}
PY
"$folder/venv/bin/python" served.py
