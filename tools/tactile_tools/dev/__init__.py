"""Commands for developers of the project; a rig needs none of them."""
