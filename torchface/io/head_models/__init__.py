"""Head models of others as their authors publish them: read without pickles, sizes checked before memory is taken."""
