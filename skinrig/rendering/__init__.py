"""Pictures of fitted skin models, and how they stand against photographs."""
