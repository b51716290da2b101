"""Sends raw messages through the package's ports, for the compliance suite in `tests/`.

`wire_driver.py INSTANCE` opens `step` and `control` without a handshake. Each line of its standard
input is a request, `{"service": "step", "header": "<hex>", "payload": "<hex>"}`, and each line of
its standard output the answer, `{"header": "<hex>", "payload": "<hex>"}`.
"""

import json
import sys

from emberwatch.channels import Node, in_turn
from emberwatch.ports import Peer, RequestPort

from emberwatch import wire

HEADERS = {
    "step": (wire.StepRequest, wire.StepReply),
    "control": (wire.ControlRequest, wire.ControlReply),
}


def main() -> None:
    with in_turn():
        peer = Peer(Node(sys.argv[1]))
        ports = {service: RequestPort(peer, service, both) for service, both in HEADERS.items()}
        for port in ports.values():
            port.create(slice_len=4096, grows=True)
    for line in sys.stdin:
        request = json.loads(line)
        header, payload = bytes.fromhex(request["header"]), bytes.fromhex(request["payload"])
        reply, answer = ports[request["service"]].exchange(header, payload, "a request", 10.0)
        print(json.dumps({"header": bytes(reply).hex(), "payload": answer.hex()}), flush=True)


if __name__ == "__main__":
    main()
