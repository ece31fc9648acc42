"""What can be wrong with a robot, its log or its model: small models, compared on held-out rows."""
