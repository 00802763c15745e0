/* Is it silence, or a service of another version of the protocol? proto/README.md, section 13. */
#ifndef FACTORBUS_VERSIONS_H
#define FACTORBUS_VERSIONS_H

#include "zenoh.h"

/* Whether services are there, and none of them speaks our version. Then a line on standard error says which they speak. */
bool only_other_versions(z_session *bus);

#endif
