/* What functions take and give: to be changed with it, here and in __init__.py. */
int djet_interface(void)
{
    return 9;
}
