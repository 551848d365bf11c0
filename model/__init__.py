"""Motion + speech -> checkpoint -> Motion: network, diffusion, trainer, speech encoder, metrics."""
