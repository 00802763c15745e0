#include "versions.h"

#include <stddef.h>
#include <stdio.h>
#include <string.h>

enum { LOOK_MS = 1000, ROOM = 200 };

static const char OURS[] = "v1", BEFORE[] = "factorbus/";

typedef struct {
    bool ours;
    char others[ROOM]; /* "v2, v3" */
} versions;

static bool has(const char *list, const char *version)
{
    size_t size = strlen(version);
    for (const char *at = strstr(list, version); at != NULL; at = strstr(at + 1, version))
        if ((at == list || at[-1] == ' ') && (at[size] == '\0' || at[size] == ',')) return true;
    return false;
}

/* Of factorbus/<version>/features/<name>/live. */
static void on_token(void *context, const char *key)
{
    versions *found = context;
    const char *begin = key + strlen(BEFORE), *end = strchr(begin, '/');
    char version[32];
    if (strncmp(key, BEFORE, strlen(BEFORE)) != 0 || end == NULL || end - begin >= (ptrdiff_t)sizeof version) return;
    snprintf(version, sizeof version, "%.*s", (int)(end - begin), begin);
    size_t size = strlen(found->others);
    if (strcmp(version, OURS) == 0) found->ours = true;
    else if (!has(found->others, version))
        snprintf(found->others + size, ROOM - size, "%s%s", size ? ", " : "", version);
}

bool only_other_versions(z_session *bus)
{
    versions found = {0};
    if (!z_look(bus, "factorbus/*/features/*/live", on_token, &found, LOOK_MS)) return false;
    if (found.ours || !*found.others) return false;
    fprintf(stderr,
            "the services here speak version %s of the protocol, this robot %s, and they do not hear each other: "
            "update the older of the two [other_protocol]\n",
            found.others, OURS);
    return true;
}
