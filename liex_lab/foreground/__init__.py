"""Which pixels are the animal: background subtraction, segmentation, height maps, crop cameras."""
