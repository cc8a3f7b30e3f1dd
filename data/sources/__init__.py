"""Where frames come from: nuScenes, a folder of images, videos, drive logs."""
