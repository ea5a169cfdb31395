"""The explorer: an object, the views taken of it and what a policy makes of them, in the browser."""
