"""Data for learning traits of faces, and ground truth to evaluate them."""
