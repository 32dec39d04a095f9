"""Objects: furniture of known form and simple solids, fitted to what one camera and the people show of them."""
