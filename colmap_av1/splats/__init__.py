"""The point cloud for splatting: points, Gaussians, undistorted images."""
