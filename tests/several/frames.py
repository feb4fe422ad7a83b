"""Drive streams as frames of HTTP/2 on a bare socket: a driver that costs next to nothing, to measure what is between
it and the server."""

import socket
import struct

from plantd.v1 import plant_service_pb2 as pb

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, RESET, SETTINGS, PING, GOAWAY, WINDOW = 0, 1, 3, 4, 6, 7, 8
STREAM = 1
ENDS_HEADERS = 4
IS_ANSWER = 1
WIDE = (1 << 31) - 1


class Driver:
    """A stream of `Drive`, by which a plant is stepped."""

    def __init__(self, place, name, plant):
        host, port = place.rsplit(":", 1)
        self._socket = socket.create_connection((host, int(port)), timeout=30)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._read = b""
        #: Beginnings of gRPC messages of the answer.
        self._body = b""
        self._sequence = 0
        headers = {
            ":method": "POST",
            ":scheme": "http",
            ":path": "/plantd.v1.PlantService/Drive",
            ":authority": name,
            "te": "trailers",
            "content-type": "application/grpc",
        }
        self._socket.sendall(
            PREFACE
            # What the peer sends is never held up: the window of the stream, and that of the connection.
            + frame(SETTINGS, 0, 0, struct.pack(">HI", 4, WIDE))
            + frame(WINDOW, 0, 0, struct.pack(">I", WIDE - 65535))
            + frame(HEADERS, ENDS_HEADERS, STREAM, b"".join(literal(*pair) for pair in headers.items()))
        )
        self._send(pb.DriveRequest(open=pb.DriveOpen(id=plant)))
        answer = self._receive()
        assert answer.WhichOneof("response") == "opened", answer

    def step(self, u):
        """Takes a step, and gives the state."""
        self._sequence += 1
        self._send(pb.DriveRequest(input=pb.DriveInput(sequence=self._sequence, u=[u])))
        answer = self._receive()
        assert answer.WhichOneof("response") == "step", answer
        return answer.step.state

    def _send(self, message):
        body = message.SerializeToString()
        body = struct.pack(">BI", 0, len(body)) + body
        self._socket.sendall(frame(DATA, 0, STREAM, body))

    def _receive(self):
        while True:
            if len(self._body) >= 5:
                length = int.from_bytes(self._body[1:5], "big")
                if len(self._body) >= 5 + length:
                    message, self._body = self._body[5 : 5 + length], self._body[5 + length :]
                    return pb.DriveResponse.FromString(message)
            kind, flags, body = self._frame()
            if kind == DATA:
                self._body += body
            elif kind in (SETTINGS, PING) and not flags & IS_ANSWER:
                self._socket.sendall(frame(kind, IS_ANSWER, 0, body if kind == PING else b""))
            elif kind in (RESET, GOAWAY):
                raise ConnectionError(f"the stream has ended: frame {kind}, {body!r}")

    def _frame(self):
        while len(self._read) < 9 or len(self._read) < 9 + int.from_bytes(self._read[:3], "big"):
            more = self._socket.recv(65536)
            if not more:
                raise ConnectionError("the connection has ended")
            self._read += more
        length = int.from_bytes(self._read[:3], "big")
        kind, flags, body = self._read[3], self._read[4], self._read[9 : 9 + length]
        self._read = self._read[9 + length :]
        return kind, flags, body

    def close(self):
        self._socket.close()


def frame(kind, flags, stream, body):
    return len(body).to_bytes(3, "big") + bytes([kind, flags]) + stream.to_bytes(4, "big") + body


def literal(name, value):
    """A header as HPACK writes one that stands in no table."""
    assert len(name) < 127 and len(value) < 127
    return b"\0" + bytes([len(name)]) + name.encode() + bytes([len(value)]) + value.encode()
