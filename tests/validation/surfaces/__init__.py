"""The instrument in the field: real pictures, other water, any surface."""
