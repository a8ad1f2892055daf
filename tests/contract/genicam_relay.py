"""A relay before a GigE Vision camera's control port: it gives the camera a clock that can be latched, and faults."""

from __future__ import annotations

import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Self

PORT = 3956
DISCOVERY_ACK, READ_REGISTER, WRITE_REGISTER = 0x0003, 0x0080, 0x0082
LATCH, HIGH, LOW = 0x0944, 0x0948, 0x094C
CURRENT_ADDRESS = 0x24
DENIED = 0x8006
HEADER = struct.Struct(">BBHHH")
ACK = struct.Struct(">HHHH")


class Relay:
    """A GigE Vision camera at an address of its own. clock_ns : its clock, latched on request."""

    def __init__(
        self, address: str = "127.0.0.2", camera: str = "127.0.0.1", *, clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self.address = address
        self.latches: list[int] = []
        self.denied: set[int] = set()
        self._camera = (camera, PORT)
        self._clock_ns = clock_ns
        self._host: tuple[str, int] | None = None
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind((address, PORT))
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.connect(self._camera)
        self._ours, self._stop = socket.socketpair()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.send(b".")
        self._thread.join()
        for end in (self._near, self._far, self._ours, self._stop):
            end.close()

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self._near, self._far, self._ours], [], [])
            if self._ours in ready:
                return
            if self._near in ready:
                packet, host = self._near.recvfrom(65536)
                self._host = host
                answer = self._answer(packet)
                if answer is None:
                    self._far.send(packet)
                else:
                    self._near.sendto(answer, host)
            if self._far in ready:
                try:
                    packet = self._far.recv(65536)
                except ConnectionError:
                    continue
                if self._host is not None:
                    self._near.sendto(self._readdressed(packet), self._host)

    def _answer(self, packet: bytes) -> bytes | None:
        """What the relay answers by itself; None if the camera is to be asked."""
        _, _, command, _, request = HEADER.unpack_from(packet)
        if command not in {READ_REGISTER, WRITE_REGISTER}:
            return None
        (register,) = struct.unpack_from(">I", packet, HEADER.size)
        if register in self.denied:
            return ACK.pack(DENIED, command + 1, 0, request)
        if command == WRITE_REGISTER and register == LATCH:
            self.latches.append(self._clock_ns())
            return ACK.pack(0, command + 1, 4, request) + struct.pack(">I", 1)
        if command == READ_REGISTER and register in {HIGH, LOW} and self.latches:
            value = self.latches[-1] >> 32 if register == HIGH else self.latches[-1] & 0xFFFFFFFF
            return ACK.pack(0, command + 1, 4, request) + struct.pack(">I", value)
        return None

    def _readdressed(self, packet: bytes) -> bytes:
        _, command, _, _ = ACK.unpack_from(packet)
        if command != DISCOVERY_ACK:
            return packet
        at = ACK.size + CURRENT_ADDRESS
        return packet[:at] + socket.inet_aton(self.address) + packet[at + 4 :]
