"""What further views of an object would show: how visible it is, and what they would tell."""
