"""What traits of faces are learned from and held against."""
