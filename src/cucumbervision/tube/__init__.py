"""Pure maths on arrays: no files, no classes of the project's, nothing imported from it."""
