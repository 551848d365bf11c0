"""Motion + speech -> checkpoint -> Motion: network, diffusion, trainer, speech encoder, metrics."""

import os

# Waiting OpenMP threads must sleep, not spin: on cores that others use too, two spinning threads took 4 000 ms for a
# training step, one thread 200 ms, two sleeping threads 44 ms. libgomp reads this when torch is loaded, so it stands
# before any import of it.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
