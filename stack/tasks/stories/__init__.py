"""Stories: acts as data, one after the other, each with its condition for done, its words and its skill."""
