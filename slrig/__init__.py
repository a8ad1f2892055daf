"""slrig: drives structured-light rigs, captures, and reconstructs triangle meshes in millimetres."""

import os

# GNU OpenMP, on which the kernels' threads run unless TBB is there, has them spin for some 0.1 ms wherever one waits
# for another. With other work on the cores each wait then lasts until the scheduler's next turn: two busy processes on
# two cores made a scan 3.3 times as slow instead of twice, and meshes of a few triangles 500 times. Read when the
# library is loaded, at the first kernel; what the user has set stands.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")
