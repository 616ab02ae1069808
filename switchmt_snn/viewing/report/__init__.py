"""The page of a run, and of several runs side by side: facts, figures, HTML. It only reads run folders."""
