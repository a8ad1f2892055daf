"""A virtual machine for tests that need a kernel's own drivers: `tests.contract.guest.machine.run_in_guest`."""
