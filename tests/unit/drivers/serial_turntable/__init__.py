"""Tests of `drivers.serial_turntable`, on stand-ins that were written from the documents of the protocols."""
