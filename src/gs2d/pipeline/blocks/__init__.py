"""A capture in blocks: where they are cut, what each trains, and how they become one scene again."""
