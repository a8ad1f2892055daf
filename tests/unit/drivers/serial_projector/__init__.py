"""Tests of the serial projector, its protocol and its reference box."""
