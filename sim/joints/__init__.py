"""What a model's joints do beyond turning: the friction of their gears, and closed loops."""
