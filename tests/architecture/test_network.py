"""No command opens a connection beyond this machine, but to the addresses that it is given."""

import ast
import socket

import pytest
from fixtures.product_code import PACKAGES, ROOT, modules, nodes_of, tree_of

NETWORK = {"aiohttp", "ftplib", "http", "httpx", "requests", "smtplib", "socket", "socketserver"}
NETWORK |= {"ssl", "telnetlib", "urllib", "urllib3", "webbrowser", "websockets", "xmlrpc"}
HARMLESS = {"urllib.parse", "http"}
"""Parsing of addresses; status codes."""
PERMITTED = {
    "capture/devices/cameras/remote_camera.py": "socket",  # a camera at the given address
    "rigsim/world/box_endpoints.py": "socket",  # serve, on this machine
    "rigsim/world/camera_service.py": "socketserver",  # serve, on this machine
    "skinrig/viewer/server.py": "http.server",  # view --serve, on this machine
}


def network_imports():
    found = {}
    for path in modules(*PACKAGES):
        for node in nodes_of(tree_of(path), ast.Import, ast.ImportFrom):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif node.module and not node.level:
                names = [node.module]
            for name in names:
                if name.partition(".")[0] in NETWORK and name not in HARMLESS:
                    found[path.relative_to(ROOT).as_posix()] = name
    return found


def test_network_modules_are_imported_by_four_files():
    assert network_imports() == PERMITTED


@pytest.mark.parametrize("address", [("192.0.2.1", 80), ("0.0.0.0", 0), ("", 0), ("::", 0)])
def test_socket_beyond_this_machine_fails_a_test(address):
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    with socket.socket(family) as opened:
        with pytest.raises(pytest.fail.Exception, match="an address of this machine"):
            opened.connect(address)
        with pytest.raises(pytest.fail.Exception, match="an address of this machine"):
            opened.bind(address)
