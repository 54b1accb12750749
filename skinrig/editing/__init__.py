"""Edit traits and spots of a face: `skinrig edit`."""
