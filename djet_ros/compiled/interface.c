/* Version of the functions' signatures: change it with them, here and in __init__.py. */
int djet_interface(void)
{
    return 13;
}
