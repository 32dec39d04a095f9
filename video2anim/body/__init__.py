"""The human body: models that give the 22-joint skeleton bone lengths and a surface, and contact of body parts."""
