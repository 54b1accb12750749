"""Parts of a face that are not skin: eyes behind lids that open, and hair."""
