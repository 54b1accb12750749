"""Maps of skin tone, which several rigs share."""
