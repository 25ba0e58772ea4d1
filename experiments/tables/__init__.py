"""The paper's tables: methods on scenes, every cell kept; and what all of them share."""
