"""Train the segmentation network on synthetic slices alone: `python -m data_synth.training`."""
