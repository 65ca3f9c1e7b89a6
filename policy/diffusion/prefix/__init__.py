"""The planner of CLoSD (DiP): what comes next, given the motion so far, a sentence and where body parts are to be."""
